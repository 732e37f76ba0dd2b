"""What several recordings of one sheet say together, in sentences and cells of tables, from joint.json."""

from collections.abc import Mapping, Sequence
from typing import Any

from .discrepancy_page import sizes_with_sd

VERDICTS = {
    "no-effect": "All recordings together show no missing effect of the tissue.",
    "effect": "All recordings together name an effect of the tissue.",
    "ambiguous": "All recordings together have an effect of the tissue, but do not distinguish it from others.",
    "effect-with-remainder": "All recordings together name an effect of the tissue, and a residual stays unexplained.",
    "unexplained": "All recordings together have a residual that no effect of the tissue explains.",
}
"""Sentence for each verdict."""
SHOWN = 8
"""Most sets of effects in the table."""


def joint_sentences(joint: Mapping[str, Any]) -> list[str]:
    """Return what several recordings say together, in sentences."""
    sentences = [VERDICTS[joint["verdict"]]]
    for effect in joint["effects"]:
        sentences.append(
            f"{_name(effect)}, in all recordings: {_sizes(effect)}; its probability is {effect['probability']:.2f}."
        )
    if joint["ambiguous_with"]:
        sentences.append(f"They do not distinguish this from {', '.join(joint['ambiguous_with'])}.")
    for one in joint["recordings"]:
        if one["own_effects"]:
            own = ", ".join(f"{_name(effect)} {_sizes(effect)}" for effect in one["own_effects"])
            sentences.append(f"{one['name']} alone: {own}.")
    sentences += [f"{one['effects']} is not taken: {one['why']}." for one in joint["refused"]]
    return sentences


def joint_rows(joint: Mapping[str, Any]) -> list[list[str]]:
    """Return a row of cells for each of the likeliest sets of effects: names, probability, and log evidences [nat].

    Log evidences, of all recordings together and of each with its own effects, are differences from those of no effect.
    """
    nothing = next(one for one in joint["posterior"] if not one["effects"])
    return [_row(one, nothing) for one in joint["posterior"][:SHOWN]]


def _row(one: Mapping[str, Any], nothing: Mapping[str, Any]) -> list[str]:
    cells = [_set(one["effects"]), f"{one['probability']:.2f}", f"{one['log_evidence'] - nothing['log_evidence']:.1f}"]
    for name, each in one["recordings"].items():
        gain = each["log_evidence"] - nothing["recordings"][name]["log_evidence"]
        beside = f" beside {_set(each['own_effects'])}" if each["own_effects"] else ""
        cells.append(f"{gain:.1f}{beside}")
    return cells


def _set(effects: Sequence[Mapping[str, Any]]) -> str:
    return " and ".join(map(_name, effects)) or "nothing"


def _name(effect: Mapping[str, Any]) -> str:
    return effect["name"] if effect["site"] is None else f"{effect['name']} at site {effect['site']}"


def _sizes(effect: Mapping[str, Any]) -> str:
    return sizes_with_sd(effect["theta"], effect["sd"], effect["units"])
