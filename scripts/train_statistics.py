"""Train statistics from rendered heads, torch style: a Dataset, a DataLoader with workers, one ``update`` a subject,
checkpoints, save.

    python scripts/train_statistics.py --config configs/paper.yaml --output statistics/paper

``facerelight train`` takes the same flags; both call :func:`facerelight.train.run.train`.
"""

import sys

from facerelight.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
