"""Road users of the built-in world.

``role_assignment`` draws who takes part, ``placement`` where vehicles start, and ``simulation`` moves them;
``lane_changes`` decides on lane changes, whose paths ``lateral`` builds.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
