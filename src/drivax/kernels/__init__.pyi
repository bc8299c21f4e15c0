from .library import in_use, state, without_kernels

__all__ = ["in_use", "state", "without_kernels"]
