"""Memory that is freed, and taken again at once by the next picture of the same size."""

import ctypes
import platform

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of glibc's mallopt


def keep_freed_memory() -> bool:
    """Have the C library keep the memory that is freed; whether it will.

    By default glibc gives it back and takes it anew once enough is free at the top of its heap, and each page that is
    taken anew has to be cleared first.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return bool(mallopt(_TRIM_THRESHOLD, 2**31 - 1) and mallopt(_MMAP_THRESHOLD, 2**25))
