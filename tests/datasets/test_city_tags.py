"""Places: the same city has the same name, whichever data set it comes from."""

from __future__ import annotations

import pytest

from drivax.datasets.parsing import PLACES, place_tags


@pytest.mark.parametrize(
    ("city", "locations"),
    [
        ("boston", ["boston-seaport", "us-ma-boston", "boston", "Boston"]),
        (
            "singapore",
            ["singapore-onenorth", "singapore-queenstown", "singapore-hollandvillage", "sg-one-north"],
        ),
        ("pittsburgh", ["us-pa-pittsburgh-hazelwood", "PIT", "pittsburgh"]),
        ("las-vegas", ["us-nv-las-vegas-strip", "las_vegas"]),
        ("washington-dc", ["WDC", "washington-dc"]),
    ],
)
def test_tags_hold_the_city_and_the_name_in_the_source(city, locations):
    for location in locations:
        assert place_tags(location) == {"place": city, "location": location}


def test_unknown_places_keep_their_own_word_only():
    assert place_tags("zurich-west") == {"location": "zurich-west"}
    assert place_tags(None) == place_tags("") == {}
    assert len(place_tags("x" * 5000)["location"]) == 64


def test_names_of_cities_are_unique():
    names = [name for city, others in PLACES.items() for name in (city, *others)]
    assert len(set(names)) == len(names) and all(name == name.lower() for name in names)
