"""Ranges of settings, which every config of the estimator checks alike."""


def check_ranges(config: object, *, positive: tuple[str, ...], shares: tuple[str, ...] = ()) -> None:
    """Check that the named fields of a config are positive, or lie between 0 and 1.

    Raises:
        ValueError: a field is out of its range.
    """
    name = type(config).__name__
    for key in positive:
        if not (value := getattr(config, key)) > 0:
            raise ValueError(f"{name}.{key} must be above 0; got {value}.")
    for key in shares:
        if not 0 <= (value := getattr(config, key)) <= 1:
            raise ValueError(f"{name}.{key} must lie between 0 and 1; got {value}.")
