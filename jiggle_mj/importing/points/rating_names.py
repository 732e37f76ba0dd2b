"""Names of columns and arrays that say which points are seen, or how well: their words, not letters by chance."""

import re

WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
"""A word of a name such as `is_visible`, `trackStatus` or `VIS2`."""
HIDDEN_WORD = re.compile(
    r"(?:is)?(?:nans?|exclud\w*|ignor\w*|lost|hidden|unseen|missing|masked|bad|fail(?:ed|s|ures?)?|drop(?:ped|outs?)|reject\w*)"
    r"|\w*(?<!un)(?<!non)(?<!not)(?:occlu|outlier)\w*|\w*(?:in|un|not)vis(?:ib\w*)?|\w*(?:in|not)valid\w*|notseen"
)
"""A word that is true, or large, where a point is not seen."""
SEEN_WORD = re.compile(
    r"(?:is)?(?:seen|vis(?:s|ib\w*)?|valid(?:s|ity)?|masks?|status(?:es)?|conf(?:s|id\w*)?|scores?|probs?)"
    r"|\w*(?:visib(?:s|l\w*|ilit\w*)|confidence\w*|probabilit\w*|likelihood\w*|qualit\w*|inlier\w*|(?:un|non|not)occlu\w*)"
)
"""A word that is true, or large, where a point is seen."""
NEGATION = frozenset(("not", "non", "no", "un", "never"))
"""Words that give the next rating the opposite meaning."""
QUANTITIES = frozenset(
    "area areas load loads force forces stress strain energy pressure temperature volume width height length size "
    "velocity speed time times".split()
)
"""Words of what is measured: a name that ends in one of them rates no point, as `mask_area` and `failure_load`."""


def rates_points(name: str) -> bool:
    """Return whether the name of a column or an array is that of one that says which points are seen, or are not."""
    return _meaning(name) is not None


def marks_hidden(name: str) -> bool:
    """Return whether a name is that of ratings that are true, or large, where a point is not seen."""
    return _meaning(name) is False


def _meaning(name: str) -> bool | None:
    """Return whether large values are those of seen points; None where the name rates none.

    The first word that marks the points that are not seen decides, then the first that marks those that are: an
    outlier's score, an occlusion's probability.
    """
    words = [word.lower() for word in WORD.findall(name)]
    if not words or words[-1] in QUANTITIES:
        return None
    for pattern, seen in ((HIDDEN_WORD, False), (SEEN_WORD, True)):
        for number, word in enumerate(words):
            if pattern.fullmatch(word):
                negated = number > 0 and words[number - 1] in NEGATION
                return seen != negated
    return None
