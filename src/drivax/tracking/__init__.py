"""Run folders, checkpoints, metric logs, progress and worker processes.

``run_folder`` writes ``run.json`` and ``config.yaml``, ``sinks`` writes ``metrics.jsonl``; :mod:`drivax.files` replaces
outputs, and :mod:`drivax.seal` detects edits.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
