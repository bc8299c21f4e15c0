"""Checks of user-defined components for tests; errors name the violated rule and the cure.

A check takes a component or its dotted name; planners and traffic models also by name. The built-in
reward terms, metrics, encoders, traffic models and planners pass, experts with ``privileged=True``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
