"""Reports: HTML pages that show a run."""
