import os
import subprocess
import sys
from pathlib import Path

# The number of cases, and the step between those that run without --extremes=full: coprime to the numbers of paddings,
# interpolations, types and values, so that all of these run.
GROUPS = {"images": (1099, 47), "flows": (264, 5), "params": (880, 13), "depths": (29, 1)}


def test_invalid_values_neither_crash_nor_spread(full_extremes):
    steps = {group: 1 if full_extremes else every for group, (_, every) in GROUPS.items()}
    script, root = Path(__file__).with_name("invalid_values.py"), Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(script), *(f"{group}={every}" for group, every in steps.items())]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=3600, check=False)
    lines = done.stdout.splitlines()
    assert done.returncode >= 0, f"signal {-done.returncode} in {lines[-1:]}: {done.stderr}"
    assert [line for line in lines if line.startswith("WRONG")] == []
    assert done.returncode == 0, done.stderr
    counts = [line for line in lines if line.startswith("cases of ")]
    assert counts == [f"cases of {group}: {-(-GROUPS[group][0] // every)}" for group, every in steps.items()]
