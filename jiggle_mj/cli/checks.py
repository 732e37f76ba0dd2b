"""`bench`, `scene-check` and `doctor`: how fast, how stiff, and what this machine lacks."""

import json
import sys
from dataclasses import asdict
from math import isnan
from typing import Annotated, Literal

import tyro
from rich.table import Table

from .options import AsJson, Disturb, Name
from .terminal import console, log


def bench(
    part: Annotated[Literal["estimator", "reference"], tyro.conf.Positional] = "estimator",
    /,
    *,
    sizes: tuple[int, ...] | None = None,
    gate: bool = False,
    as_json: AsJson = False,
) -> None:
    """Time the estimator's or the reference tissue's parts on this machine, compile time apart; medians.

    Args:
        part: estimator, or reference.
        sizes: about how many particles (600, 1200 if left out; the first is compared with the paper's filter too, and
            of more than 10000 the solver is timed alone), or vertices of the reference (300, 625, 1200, 2500).
        gate: fail where something became worse than the committed baseline allows.
        as_json: print the figures to stdout.
    """
    from jiggle_mj.eval.benchmark.estimator_benchmark import SIZES, baseline, benchmark, regressions

    if part == "reference":
        from jiggle_mj.eval.benchmark import reference_benchmark as reference

        metrics = reference.reference_benchmark(sizes or reference.SIZES, log=log)
    else:
        metrics = benchmark(sizes or SIZES, paper=True, log=log)
    table = Table("", "figure", "", box=None)
    for name, entry in metrics.items():
        value = entry["value"]
        table.add_row(name, value if isinstance(value, str) else f"{value:.3g}", str(entry["unit"]))
    console.print(table)
    if as_json:
        print(json.dumps(metrics))
    worse = regressions(metrics, baseline()) if gate else []
    for line in worse:
        console.print(line, style="red", highlight=False)
    if worse:
        sys.exit(1)


def scene_check(scene: Name, /, *, disturb: Disturb = (), as_json: AsJson = False) -> None:
    """Static load tests of a scene's compiled sheet: its stiffness beside the typed and the declared one.

    Args:
        scene: a shipped scene or the path of a scene file.
        disturb: see run; those of the material that begin at 0 count.
        as_json: print the figures to stdout.
    """
    from jiggle_mj.scenes import disturbed, load_scene
    from jiggle_mj.scenes.load_tests import QUANTITIES, far_from_declared, load_tests, typed

    loaded = disturbed(load_scene(scene), disturb)
    with console.status("load tests") as status:
        found = load_tests(loaded, log=lambda text: status.update(f"load tests: {text}"))
    stated = typed(loaded.tissue)
    spacings = [f"{1e3 * one.spacing:.2f} mm" for one in found]
    table = Table("effective", "unit", "typed", *spacings, box=None)
    for name, unit in QUANTITIES.items():
        ratios = ["too coarse" if isnan(value := getattr(one, name)) else f"{value:.4g}" for one in found]
        table.add_row(name.replace("_", " "), unit, f"{getattr(stated, name):.4g}", *ratios)
    console.print(table)
    for line in far_from_declared(loaded, found):
        console.print(line, style="yellow", markup=False, highlight=False)
    if as_json:
        plain = [{key: None if isnan(value) else value for key, value in asdict(one).items()} for one in found]
        print(json.dumps({"typed": asdict(stated), "effective": plain}))


def doctor(*, as_json: AsJson = False) -> None:
    """Check this machine: versions, JAX devices, offscreen OpenGL, cores and memory.

    Args:
        as_json: print the checks to stdout.
    """
    from ..doctor import doctor as examine

    checks = examine()
    table = Table("", "check", "found", "what to do", box=None)
    for check in checks:
        table.add_row("[green]ok[/]" if check.ok else "[red]no[/]", check.name, check.detail, check.remedy or "")
    console.print(table)
    if as_json:
        print(json.dumps([asdict(check) for check in checks]))
    if not all(check.ok for check in checks):
        sys.exit(1)
