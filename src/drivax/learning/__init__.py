"""Training of policies: algorithms, their environment, the training loop, and trained policies.

``replay`` stores the transitions of a run; ``experience`` samples minibatches of logged steps for offline learning; PPO
shuffles its own rollouts (``algorithms.ppo``). ``training_log.rank`` decides which checkpoint is the best, and
``drivax.tracking.Checkpoints`` keeps it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
