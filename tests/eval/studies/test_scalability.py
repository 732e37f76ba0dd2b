"""The table of planning times, by hand."""

from jiggle_mj.eval.studies.scalability import PRINTED, markdown


def test_each_size_has_its_line_and_the_papers_seconds_where_there_are_any():
    lines = markdown({600: (1.42, 1.38), 2400: (7.6, 21.2)}).splitlines()
    assert lines[2] == f"| 600 | {PRINTED[600]} s | 1.4 s | 1.4 s |"
    assert lines[3] == "| 2400 | \N{EN DASH} | 7.6 s | 21 s |"
    assert lines[-1].startswith("Medians of three on ")
