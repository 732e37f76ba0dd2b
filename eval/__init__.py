"""The only place where truth meets estimate: carrying, metrics, calibration, tracking, score and the report."""
