"""docs/EFFECTS.md names every effect of the library, with its priors and where their scale comes from."""

import re
from pathlib import Path

from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.scenes import DISTURBANCES

PAGE = (Path(__file__).parents[2] / "docs" / "EFFECTS.md").read_text(encoding="utf-8")


def test_the_page_lists_the_library():
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", PAGE, re.MULTILINE))
    assert list(rows) == [effect.name for effect in LIBRARY]
    for effect in LIBRARY:
        prior, where, confused, source = rows[effect.name].split(" | ")
        assert prior.startswith(f"{effect.prior_sd[0]:g}"), effect.name
        assert where.startswith(str(effect.sites)) == (effect.sites > 1), effect.name
        assert confused.split(", ") == list(effect.confounded_with), effect.name
        assert source == effect.source, effect.name


def test_effects_have_the_names_of_the_disturbances_that_cause_them():
    """Three have none of their own.

    They are `swing`, since the sheets of the scenes lie, `surface_height`, which any sheet has, `tethering`, which
    is the disturbance `adhesion` with a film that does not come off, and `force_scale`, which is a wrong declaration.
    """
    assert {effect.name for effect in LIBRARY} - {"swing", "surface_height", "tethering", "force_scale"} <= set(
        DISTURBANCES
    )
