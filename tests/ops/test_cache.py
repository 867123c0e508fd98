import numpy as np
import pytest

from torchrefract.ops import numba_cpu


@pytest.mark.parametrize("damage", ["index", "code", "full disk"])
def test_a_cache_that_fails_warns_once_and_kernels_are_compiled(tmp_path, monkeypatch, damage):
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path))
    numba_cpu._warn_of_cache.cache_clear()

    def double(x):
        return 2 * x

    def compiled() -> float:
        return numba_cpu._jit(double)(np.float64(4))

    def full(*_):
        raise OSError(28, "No space left on device")

    assert compiled() == 8
    files = [*tmp_path.rglob("*.nbi"), *tmp_path.rglob("*.nbc")]
    assert len(files) == 2
    if damage == "full disk":
        files[0].unlink()
        monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)
    else:
        path = files[damage == "code"]
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.warns(RuntimeWarning, match="numba cannot use its cache in .*; free disk space") as warned:
        assert compiled() == compiled() == 8
    assert len(warned) == 1
