"""Where recordings were made: one name per city, whatever a data set calls it."""

from __future__ import annotations

from collections.abc import Mapping

#: Cities (the tag ``place``) and how data sets call them or their parts: nuScenes and nuPlan by the names of their
#: maps, Argoverse 2 by name or by the code in the names of its sensor maps.
PLACES: Mapping[str, tuple[str, ...]] = {
    "austin": ("atx",),
    "boston": ("boston-seaport", "us-ma-boston"),
    "dearborn": ("dtw",),
    "las-vegas": ("us-nv-las-vegas-strip",),
    "miami": ("mia",),
    "palo-alto": ("pao",),
    "pittsburgh": ("pit", "us-pa-pittsburgh-hazelwood"),
    "singapore": ("sg-one-north", "singapore-hollandvillage", "singapore-onenorth", "singapore-queenstown"),
    "washington-dc": ("wdc",),
}
_CITY_OF = {name: city for city, names in PLACES.items() for name in (city, *names)}
_LONGEST = 64


def place_tags(location: str | None) -> dict[str, str]:
    """The tags ``place`` (the city) and ``location`` (the source's own word, which may name a part of the city).

    Args:
        location: What the source calls the place; None or empty where it does not tell, which gives no tag.

    Returns:
        ``location`` alone where the city is not known: ``place`` never holds the private word of one data set.
    """
    if not location:
        return {}
    city = _CITY_OF.get(location.lower().replace("_", "-"))
    return ({} if city is None else {"place": city}) | {"location": location[:_LONGEST]}
