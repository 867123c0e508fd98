"""What numba compiles; imported by `compiled.kernels` alone, since numba may be missing and takes its time."""
