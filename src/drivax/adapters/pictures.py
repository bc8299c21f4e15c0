"""What an environment renders: the scenario from above, with the path that was driven."""

from __future__ import annotations

from typing import Any

import numpy as np

from drivax.errors import UsageError
from drivax.report.pictures.still import draw_scenario
from drivax.scenario.schema import Scenario
from drivax.simulator.types import AgentContext


def path_of(context: AgentContext, before: Any = None) -> Any:
    """Motions from the first step of the log to the present one ``[step + 1, 4]``; NaN where nobody knows.

    Args:
        context: The present context.
        before: The path one step ago; None where an episode begins.
    """
    history, step = np.asarray(context.history), int(context.step)
    if before is not None:
        return np.concatenate([before, history[-1:]])
    known = history[-min(step + 1, len(history)) :]
    return np.concatenate([np.full((step + 1 - len(known), 4), np.nan, np.float32), known])


def picture(scenario: Scenario, path: Any) -> np.ndarray[Any, Any]:
    """The scenario at the last step of a path, as ``[height, width, 3]`` bytes.

    Raises:
        UsageError: matplotlib is not installed.
    """
    figure = draw_scenario(scenario, len(path) - 1, ego=path, legend=False)
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
    except ModuleNotFoundError as error:
        raise UsageError("matplotlib is not installed", cure="pip install 'drivax[show]'") from error
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3].copy()
