import os
import subprocess
import sys
from pathlib import Path

import pytest

# The cases of a group, and of how many one is tried where not all are asked for: a number prime to those of the
# paddings, interpolations, types and values, so that all of them are among the ones that are tried.
GROUPS = {"images": (679, 7), "flows": (264, 5), "params": (408, 5), "depths": (29, 1)}


@pytest.mark.parametrize("group", GROUPS)
def test_no_value_ends_the_process_or_leaves_its_pixel(group, full_extremes):
    count, every = GROUPS[group]
    every = 1 if full_extremes else every
    script, root = Path(__file__).with_name("poison.py"), Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, str(script), group, str(every)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    lines = done.stdout.splitlines()
    assert done.returncode >= 0, f"signal {-done.returncode} in {lines[-1:]}: {done.stderr}"
    assert [line for line in lines if line.startswith("WRONG")] == []
    assert done.returncode == 0, done.stderr
    assert lines[-1] == f"cases: {-(-count // every)}"
