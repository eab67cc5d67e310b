"""Compiled kernels: the `kernel` decorator, the types of their arguments, and the cache that keeps the machine code."""

from leapnav.envs.kernels.compilation import prepare
from leapnav.envs.kernels.decorator import kernel, record_type

__all__ = ["kernel", "prepare", "record_type"]
