"""The verbs `scenes`, `effects` and `disturbances`: what there is, one line each, on stdout."""

import json

from .options import AsJson


def scenes(*, as_json: AsJson = False) -> None:
    """List the shipped scenes, which run and record know by name.

    Args:
        as_json: print the list as JSON, with size, number of attachments and policy.
    """
    from jiggle_mj.scenes import load_scene, scene_summary, shipped_scenes

    listed = [
        {
            "name": name,
            "size_m": scene.tissue.size,
            "n_attachments": len(scene.attachments),
            "policy": scene.programme.policy,
            "summary": scene_summary(name),
        }
        for name, scene in ((name, load_scene(name)) for name in shipped_scenes())
    ]
    rows = [(str(scene["name"]), str(scene["summary"])) for scene in listed]
    _print(rows, listed, as_json=as_json)


def effects(*, as_json: AsJson = False) -> None:
    """List the effects that close-loop tests by default: name, number and units of its parameters, source of the prior.

    docs/EFFECTS.md describes them.

    Args:
        as_json: print the list as JSON.
    """
    from jiggle_mj.estimator.effects import LIBRARY

    listed = [
        {"name": effect.name, "units": list(effect.units), "prior_sd": list(effect.prior_sd), "source": effect.source}
        for effect in LIBRARY
    ]
    rows = [
        (effect.name, f"{len(effect.units)} [{', '.join(dict.fromkeys(effect.units))}]", effect.source)
        for effect in LIBRARY
    ]
    _print(rows, listed, as_json=as_json)


def disturbances(*, as_json: AsJson = False) -> None:
    """List the disturbances of scenes, for --disturb NAME=MAGNITUDE; docs/DISTURBANCES.md describes them.

    Args:
        as_json: print the list as JSON.
    """
    from jiggle_mj.scenes import DISTURBANCES

    listed = [{"name": name, "summary": _first_line(kind)} for name, kind in DISTURBANCES.items()]
    rows = [(entry["name"], entry["summary"]) for entry in listed]
    _print(rows, listed, as_json=as_json)


def _first_line(described: type) -> str:
    return (described.__doc__ or "").strip().partition("\n")[0]


def _print(rows: list[tuple[str, ...]], listed: list, *, as_json: bool) -> None:
    """Print aligned lines to stdout, or the list as JSON."""
    if as_json:
        print(json.dumps(listed))
        return
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())
