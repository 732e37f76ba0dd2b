"""`table`: many runs, and their figures as Markdown."""

from typing import Annotated

import tyro

from ..errors import OptionError
from ..options import Sensing
from .options import Out, RowsName, TableName
from .terminal import console, log


def table(
    name: Annotated[TableName, tyro.conf.Positional],
    /,
    *,
    out: Out,
    seeds: tuple[int, ...] | None = None,
    sensing: Sensing | None = None,
    jobs: int | None = None,
    rows: tuple[RowsName, ...] | None = None,
) -> None:
    """Run a table of scenes and seeds, and print it as Markdown; what is in OUT already is not run again.

    Args:
        name: main is that of docs/RESULTS.md; active is the paper's comparison of policies, with ours; acts is whether
            failed cuts and sutures are noticed; undeclared is whether close-loop names what nobody declares;
            scalability times plans at three sizes, on this machine; simulation and one-lift are the paper's, with its
            printed figures and all baselines.
        out: holds a folder for each run, and of active the curves, active.html.
        seeds: of each row; 0 to 2 for main, 0 to 5 for acts, 0 to 4 for undeclared and 0 to 9 for the paper's if left
            out.
        sensing: of active; particles if left out.
        jobs: of active, acts and undeclared: how many runs at a time; as many as there are usable cores if left out.
        rows: of undeclared: one effect of the library, two together, one from images, what is outside the library, or
            nothing; all if left out.
    """
    from jiggle_mj.eval.studies import main_table as tables
    from jiggle_mj.eval.studies import paper_tables

    if sensing is not None and name != "active":
        raise OptionError(f"--sensing is for the table active; got {name}.")
    if jobs is not None and name not in ("active", "acts", "undeclared"):
        raise OptionError(f"--jobs is for the tables active, acts and undeclared; got {name}.")
    if rows is not None and name != "undeclared":
        raise OptionError(f"--rows is for the table undeclared; got {name}.")
    if name == "main":
        print(tables.markdown(tables.measure(tables.MAIN, seeds or range(3), out, log=log)))
    elif name == "active":
        from jiggle_mj.eval.studies import active_table

        from ..worker_processes import WorkerProcesses

        with WorkerProcesses(jobs) as executor:
            runs = active_table.measure(
                active_table.SCENES,
                active_table.POLICIES,
                seeds or range(10),
                out,
                sensing=sensing or "particles",
                executor=executor,
                log=log,
            )
        print(active_table.markdown(runs))
        active_table.write_curves(runs, out / active_table.FILE)
        console.print(f"curves: {out / active_table.FILE}")
    elif name == "acts":
        from jiggle_mj.eval.studies import acts_table

        from ..worker_processes import WorkerProcesses

        with WorkerProcesses(jobs) as executor:
            found = acts_table.measure(acts_table.SCENES, seeds or range(6), out, executor=executor, log=log)
        print(acts_table.markdown(found))
    elif name == "undeclared":
        from jiggle_mj.eval.studies import undeclared_table as undeclared
        from jiggle_mj.eval.studies.undeclared_panel import GROUPS

        from ..worker_processes import WorkerProcesses

        names = [name for group in (rows or GROUPS) for name in GROUPS[group]]
        with WorkerProcesses(jobs) as executor:
            closed = undeclared.measure(names, seeds or range(5), out, executor=executor, log=log)
        print(undeclared.markdown(closed))
    elif name == "scalability":
        from jiggle_mj.eval.studies import scalability

        print(scalability.markdown(scalability.scalability(scalability.SIZES, log=log)))
    else:
        table, cells = paper_tables.TABLES[name], paper_tables.cells()
        print(paper_tables.markdown(table, paper_tables.measure(table, cells, seeds or range(10), out, log=log)))
