"""Training runs of a few seconds, as processes."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import yaml


def run_config(folder: Path, name: str, *, dropout: float = 0.1, **changes) -> Path:
    """Configuration file of a run on folder/set that takes a few seconds; its output goes to folder/name."""
    model = folder / f"dropout-{dropout}.yaml"
    model.write_text(
        yaml.safe_dump(
            {
                "image_size_px": 16,
                "features": 8,
                "patch_px": 1,
                "unet": {
                    "base_channels": 8,
                    "multipliers": [1, 2],
                    "blocks": 1,
                    "attention_px": [8],
                    "heads": 2,
                    "dropout": dropout,
                },
            }
        )
    )
    path = folder / f"{name}.yaml"
    path.write_text(
        yaml.safe_dump(
            {
                "output_dir": str(folder / name),
                "data": [str(folder / "set")],
                "cache_dir": str(folder / "cache"),
                "model": str(model),
                "device": "cpu",
                "stages": [
                    {"steps": 8, "image_size_px": 16, "objects": 2},
                    {"steps": 4, "image_size_px": 32, "objects": 1},
                ],
                "targets": 1,
                "checkpoint_every": 3,
                "optimizer": {"warmup_steps": 2},
            }
            | changes,
            sort_keys=False,
        )
    )
    return path


def start(config: Path, processes: int = 1, program: Sequence[str] = ("-m", "training.train")) -> subprocess.Popen:
    """The training command, or another program that takes its options; under torchrun if by more than one process."""
    root = Path(__file__).resolve().parents[1]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])}
    command = [*program, "--config", str(config)]
    if processes > 1:
        command = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}", *command]
    return subprocess.Popen(
        [sys.executable, *command],
        cwd=root,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )


def finish(config: Path) -> None:
    """Run the training command to its end."""
    process = start(config)
    assert process.wait(timeout=120) == 0, process.communicate()[0]


def losses(folder: Path) -> list[str]:
    """Lines of the log in a run's output folder."""
    path = folder / "losses.jsonl"
    return path.read_text().splitlines() if path.exists() else []
