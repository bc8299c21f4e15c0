from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from drivax.synthetic.domains import DOMAINS
from drivax.synthetic.roads.families import FAMILIES

NAMES = {family.name for family in FAMILIES}


def test_domain_shares_cover_all_families():
    assert len(NAMES) == len(FAMILIES) >= 10
    named = [{name for name, _ in domain.shares} for domain in DOMAINS.values()]
    assert set.union(*named) == NAMES
    assert all(name == domain.name for name, domain in DOMAINS.items())
    for domain in DOMAINS.values():
        assert sum(share for _, share in domain.families) == pytest.approx(1.0)
        assert sum(share for _, share in domain.shares) == pytest.approx(1.0)


def test_families_are_drawn_by_their_shares():
    rng = np.random.default_rng(0)
    for domain in DOMAINS.values():
        counts = Counter(domain.draw_family(rng).name for _ in range(4000))
        for family, share in domain.families:
            # Four standard deviations of a binomial count.
            assert abs(counts[family.name] / 4000 - share) < 4 * np.sqrt(share * (1 - share) / 4000)


def test_domains_differ_in_roads():
    grid, ring = DOMAINS["grid"], DOMAINS["ring"]
    shares = {name: dict(domain.shares) for name, domain in DOMAINS.items()}
    assert "highway" not in shares["ring"] and shares["ring"]["roundabout"] > 4 * shares["grid"]["roundabout"]
    curved = next(family for family in FAMILIES if family.name == "curved_road")
    roads = {
        d.name: [curved.build(np.random.default_rng(seed), d.style) for seed in range(20)]
        for d in (grid, ring)
    }
    width = {name: np.mean([road.lanes[0].width_m for road in drawn]) for name, drawn in roads.items()}
    limit = {name: np.mean([road.lanes[0].limit_mps for road in drawn]) for name, drawn in roads.items()}
    bays = {name: np.mean([len(road.bays) for road in drawn]) for name, drawn in roads.items()}
    assert width["grid"] > width["ring"] + 0.3 and limit["grid"] > limit["ring"] + 2.0
    assert bays["ring"] > bays["grid"]
