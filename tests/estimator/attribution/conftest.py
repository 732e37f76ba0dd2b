"""Results of closing the loop that several files of tests share, computed once."""

import pytest

from tests.support.lifted_recording import closed_over, observed


@pytest.fixture(scope="session")
def light():
    """Return a closed loop over lifts under a fifth of the declared gravity.

    That changes the lifted shape by more than the noise.
    """
    return closed_over(observed(0.2))
