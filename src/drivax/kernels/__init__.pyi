from .library import constants, in_use, state, with_reference, without_kernels

__all__ = ["constants", "in_use", "state", "with_reference", "without_kernels"]
