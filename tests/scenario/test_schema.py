from __future__ import annotations

import numpy as np
import pytest

from drivax.scenario.schema import CAR_LANE_KINDS, EDGE_KINDS, LINE_KINDS, AgentKind, among


@pytest.mark.parametrize(
    "group", [CAR_LANE_KINDS, EDGE_KINDS, LINE_KINDS, (AgentKind.CYCLIST,), (AgentKind.OTHER, AgentKind.NONE)]
)
@pytest.mark.parametrize("dtype", [np.int8, np.int64])
def test_membership_is_that_of_numpy(group, dtype):
    kind = np.arange(-1, 40, dtype=dtype).repeat(2).reshape(-1, 2)
    assert np.array_equal(among(kind, group), np.isin(kind, group))
    assert among(kind[:0], group).shape == (0, 2)
