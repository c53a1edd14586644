"""Pack the default statistics into ``facerelight/data/standard``, compressed: the package relights without training.

Only needed to rebuild the packed files that the package already carries, whenever the default config changes:

    python scripts/data/pack_statistics.py                        # trains them first, in the user's cache: two minutes
    python scripts/data/pack_statistics.py --statistics FOLDER    # already trained, not compressed
"""

import json
from dataclasses import asdict
from pathlib import Path

from facerelight.config import DEFAULT_CONFIG, PACKAGED, default_statistics_folder
from facerelight.evaluation.results import ScriptParser
from facerelight.inference.relighter import StatisticalRelighter


def trained(folder: Path | None) -> Path:
    """The folder of the full statistics; trained where none is given and none is cached."""
    place = folder or default_statistics_folder(DEFAULT_CONFIG)
    if folder is None and not (place / "statistics.safetensors").exists():
        from facerelight.train.run import train

        train(DEFAULT_CONFIG, place)
    return place


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--statistics", type=Path, default=None, help="trained with the default config")
    parser.add_argument("--output", type=Path, default=PACKAGED, help="folder (default: the package's own)")
    parser.add_argument("--coarseness", type=float, default=1.0, help="of the rounding (default: 1)")
    args = parser.parse_args()
    relighter = StatisticalRelighter.from_pretrained(trained(args.statistics))
    notes = relighter.statistics.metadata
    if notes.get("config") != json.loads(json.dumps(asdict(DEFAULT_CONFIG))):
        raise SystemExit(f"statistics: expected those of the default config, got {notes.get('config')}; train anew")
    if relighter.statistics.describe()["rank"] != DEFAULT_CONFIG.fit.rank:
        raise SystemExit("statistics: expected full ones, got compressed ones; train anew")
    notes["config_version"] = DEFAULT_CONFIG.key()
    relighter.save_pretrained(args.output, compress=args.coarseness)
    for path in sorted(args.output.glob("*.safetensors")):
        path.chmod(0o644)  # who installs a package is not who uses it
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
