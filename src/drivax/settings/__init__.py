"""Configuration records: frozen dataclasses to and from YAML, with command-line overrides.

A configuration record holds scalars, strings, literals, paths, tuples, mappings, other records, unions of records,
which carry a ``kind`` key in YAML (:func:`kind_of`), and user-defined objects by ``package.module:name``. Missing keys
keep the defaults of the enclosing record. In a record with presets (a class method ``preset(name)``), the key
``preset`` names the preset to start from. A file may extend a preset (``extends: ppo``) or a file relative to it
(``extends: base.yaml``): its settings are merged over those of the other. No file shadows a preset: write ``./NAME``
for a file without a suffix. An unknown key or a value of the wrong type is a :class:`~drivax.errors.UsageError` with
the dotted path and the closest valid name. A class variable ``renamed`` maps former keys to present ones.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
