"""Checks for users' own components: call one in a test; the error names the broken rule and the cure.

Each takes an object or its dotted name. The built-in components pass them too.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
