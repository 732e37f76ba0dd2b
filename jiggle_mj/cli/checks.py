"""The verbs `bench`, `scene-check` and `doctor`: speed, stiffness of a scene, and requirements of this machine."""

import json
import sys
from dataclasses import asdict
from math import isnan
from typing import Annotated, Literal

import tyro
from rich.table import Table
from rich.text import Text

from .options import AsJson, Disturb, Name
from .terminal import FAILED, console, log


def bench(
    part: Annotated[Literal["estimator", "plan", "close-loop", "reference"], tyro.conf.Positional] = "estimator",
    /,
    *,
    sizes: tuple[int, ...] | None = None,
    paper: bool = True,
    gate: bool = False,
    as_json: AsJson = False,
) -> None:
    """Measure the speed of the estimator, of a plan, of closing the loop or of the reference tissue on this machine.

    Prints the median time of each part; compile time is separate.

    Args:
        part: what to time: the estimator, a plan of the policy 'information', closing the loop over a recording (which
            takes many minutes), or the reference tissue.
        sizes: approximate numbers of particles (default 600 1200; the first is also run with the paper's filter, and
            above 10000 only the solver is timed; for a plan and for closing the loop 600), or of the reference's
            vertices (default 300 625 1200 2500).
        paper: time the paper's filter and controller too, which takes minutes on a CPU.
        gate: exit with 1 where a figure is worse than the committed baseline allows.
        as_json: print the figures to stdout as JSON.
    """
    from jiggle_mj.eval.benchmark.estimator_benchmark import SIZES, baseline, benchmark, regressions

    if part == "reference":
        from jiggle_mj.eval.benchmark import reference_benchmark as reference

        metrics = reference.reference_benchmark(sizes or reference.SIZES, log=log)
    elif part == "close-loop":
        from jiggle_mj.eval.benchmark import close_loop_benchmark as closing

        metrics = closing.close_loop_benchmark(sizes or closing.SIZES, log=log)
    elif part == "plan":
        from jiggle_mj.eval.benchmark import plan_benchmark as plan

        metrics = plan.plan_benchmark(sizes or plan.SIZES, log=log)
    else:
        metrics = benchmark(sizes or SIZES, paper=paper, log=log)
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
        sys.exit(FAILED)


def scene_check(scene: Name, /, *, disturb: Disturb = (), as_json: AsJson = False) -> None:
    """Measure the stiffness of a scene's compiled sheet by static load tests.

    Prints it beside the stiffness in the scene file and the one that is declared to the estimator.

    Args:
        scene: name of a shipped scene, or path of a scene file.
        disturb: a disturbance, as in run; only those of the material that begin at 0 have an effect.
        as_json: print the figures to stdout as JSON.
    """
    from jiggle_mj.scenes import disturbed, load_scene
    from jiggle_mj.scenes.load_tests import QUANTITIES, far_from_declared, load_tests, typed

    scene_to_test = disturbed(load_scene(scene), disturb)
    with console.status("load tests") as status:
        measured = load_tests(scene_to_test, log=lambda text: status.update(f"load tests: {text}"))
    nominal = typed(scene_to_test.tissue)
    spacings = [f"{1e3 * test.spacing:.2f} mm" for test in measured]
    table = Table("effective", "unit", "typed", *spacings, box=None)
    for name, unit in QUANTITIES.items():
        ratios = ["too coarse" if isnan(value := getattr(test, name)) else f"{value:.4g}" for test in measured]
        table.add_row(name.replace("_", " "), unit, f"{getattr(nominal, name):.4g}", *ratios)
    console.print(table)
    for line in far_from_declared(scene_to_test, measured):
        console.print(line, style="yellow", highlight=False)
    if as_json:
        plain = [{key: None if isnan(value) else value for key, value in asdict(test).items()} for test in measured]
        print(json.dumps({"typed": asdict(nominal), "effective": plain}))


def doctor(*, as_json: AsJson = False) -> None:
    """Check that this machine can run jiggle-mj, and print what to do where it cannot.

    Checks package versions, the processor, JAX, rendering, cores and memory, in the environment as it is. The last line
    says what can be done. Exits with 1 where something cannot.

    Args:
        as_json: print the verdict and the checks to stdout as JSON.
    """
    from ..doctor import can_run, verdict
    from ..doctor import doctor as run_checks

    checks = run_checks()
    table = Table("", "check", "found", "what to do", box=None)
    for check in checks:
        ok = Text("ok", "green") if check.ok else Text("no", "red")
        table.add_row(ok, check.name, check.detail, check.remedy)
    console.print(table)
    ready = can_run(checks)
    console.print(verdict(checks), style="bold" if ready else "bold red", highlight=False, soft_wrap=True)
    if as_json:
        found = {"ready": ready, "verdict": verdict(checks), "checks": [asdict(check) for check in checks]}
        print(json.dumps(found))
    if not ready:
        sys.exit(FAILED)
