"""PDM-Closed (Dauner et al. 2023): proposals, LQR tracking, forecast, scoring and emergency brake."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
