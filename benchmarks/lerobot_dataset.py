"""Reads a dataset of `shearloop recording export --format lerobot` with LeRobot itself, in an environment of its own.

python3.12 -m venv lerobot && lerobot/bin/pip install 'lerobot[dataset]'
HF_HUB_OFFLINE=1 lerobot/bin/python benchmarks/lerobot_dataset.py FOLDER
"""

import sys
from importlib.metadata import version

from lerobot.datasets.lerobot_dataset import LeRobotDataset


def main(folder: str) -> None:
    """Read every row in batches, and print the features with the last row's age."""
    from torch.utils.data import DataLoader

    dataset = LeRobotDataset("local/shearloop", root=folder)
    rows = sum(len(batch["index"]) for batch in DataLoader(dataset, batch_size=512))
    print(f"lerobot {version('lerobot')}: {rows} of {len(dataset)} rows, {dataset.fps} a second")
    last = dataset[len(dataset) - 1]
    for name, feature in dataset.features.items():
        print(f"{name} {feature['dtype']} {tuple(last[name].shape)}")
    print(f"task {last['task']!r}, ages {last['observation.age_s'].tolist()}")


if __name__ == "__main__":
    main(sys.argv[1])
