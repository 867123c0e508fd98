"""Sampling of images along flows: the PyTorch reference and faster backends with the same results."""
