"""Reset and step as pure functions of a bank, a state and an action.

``dynamics`` contains the kinematic bicycle, ``controller`` nuPlan's LQR tracker, ``contact`` collisions, their fault
and time to collision, ``ahead`` the leader, stop lines and speed ahead on a route, and pure pursuit; ``idm`` the
Intelligent Driver Model (IDM), ``traffic.reactive`` IDM traffic.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
