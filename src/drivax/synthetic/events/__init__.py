"""Labelled events: unusual situations that are staged in a scenario and stored with their actors and times.

A script reads the scenario without the event (``ego_view``) and proposes an actor's motion, with which an ego at
constant speed would come close to collision; ``adversary`` computes the deceleration that this requires of ego, and
``choosing`` checks the proposals. The scripts are registered in ``choosing.SCRIPTS``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
