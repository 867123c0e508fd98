"""What numba compiles; imported by `_compiled.kernels` alone."""
