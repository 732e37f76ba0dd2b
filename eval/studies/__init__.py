"""Studies: tables over many runs."""
