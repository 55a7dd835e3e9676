"""The Slurm template, run by bash with stand-ins for Slurm's programs and clsplat."""

import os
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "tools" / "slurm" / "blocks.sbatch"


def submitted(tmp_path, task, clsplat, *words):
    """The finished job: task of an array; clsplat: body of a shell script in its place."""
    programs = {"srun": 'exec "$@"', "scontrol": 'echo scontrol "$@"', "clsplat": clsplat}
    for name, body in programs.items():
        path = tmp_path / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"#!/bin/bash\n{body}\n")
        path.chmod(0o755)
    return subprocess.run(
        ["bash", str(SCRIPT), str(tmp_path / "city"), *words],
        capture_output=True,
        text=True,
        check=False,
        env={
            **os.environ,
            "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}",
            "SLURM_ARRAY_JOB_ID": "77",
            "SLURM_ARRAY_TASK_ID": str(task),
        },
    )


@pytest.fixture
def block(tmp_path):
    folder = tmp_path / "city" / "blocks" / "012"
    folder.mkdir(parents=True)
    return folder


def test_each_task_trains_its_block_with_a_kernel_cache(tmp_path, block):
    done = submitted(tmp_path, 12, 'echo "$@" in "$POCL_CACHE_DIR"')
    assert done.returncode == 0, done.stderr
    words, _, cache = done.stdout.strip().rpartition(" in ")
    assert words == f"block {block} --wait 300"
    assert cache.startswith("/") and not Path(cache).exists()
    assert submitted(tmp_path, 2, "exit 0", "10").returncode == 0  # 10 + 2


@pytest.mark.parametrize("code, requeued", [(130, True), (143, True), (2, False)])
def test_only_an_interrupted_training_queues_again(tmp_path, block, code, requeued):
    done = submitted(tmp_path, 12, f"exit {code}")
    assert done.returncode == code
    assert ("scontrol requeue 77_12" in done.stdout) == requeued
