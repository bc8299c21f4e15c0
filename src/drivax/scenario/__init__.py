"""Driving scenarios: recordings, their fixed-size records, scenario sets on disk, and banks on the device."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
