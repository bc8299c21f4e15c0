"""Training of policies: algorithms, their environment, the training loop, and trained policies.

- ``loop`` runs the iterations: it logs, validates, writes checkpoints, resumes. ``program`` compiles them.
- ``algorithms`` has a module per algorithm; the terms of their losses are functions of :mod:`drivax.rl`.
- ``environment`` collects rollouts; ``driving``, ``self_play`` and ``mixture`` are the environments.
- ``replay`` stores the transitions of SAC, ``experience`` samples minibatches of logged steps; PPO shuffles rollouts.
- ``training_log.rank`` decides which checkpoint is the best, and ``drivax.tracking.Checkpoints`` keeps it.
- ``policies`` loads trained policies as planners and as traffic, and exports them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
