"""Built-in algorithms, one module each, with settings, iteration, and total loss (``Ppo._loss``, ``Sac.loss``, ...).

``ppo`` and ``sac`` learn in an environment, ``behaviour_cloning``, ``cql``, ``iql``, ``awac`` and ``td3_bc`` from
logged steps, and ``warm_start``, or ``sac`` with ``demonstrations``, from both. ``off_policy`` and ``offline``
are base classes; IQL shares that of ``awac``. The terms of losses are in :mod:`drivax.rl.equations`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
