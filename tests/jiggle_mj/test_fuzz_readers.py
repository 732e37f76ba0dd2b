"""Damaged files of every kind are read or refused with one of the project's errors, in one line; nothing else.

`tools/fuzz_readers.py` does the same with many more inputs, and also looks at time and memory.
"""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jiggle_mj.errors import JiggleError
from tests.support.damaged_files import damaged
from tests.support.damaged_imports import IMPORTS
from tests.support.valid_files import READERS

MAX_MESSAGE = 1000
"""Longest message [characters]: 200 of the content, twice, and the path."""


@pytest.fixture(scope="module", params=[*READERS.items(), *IMPORTS.items()], ids=lambda item: item[0])
def reader(request, tmp_path_factory):
    return request.param[1](tmp_path_factory.mktemp("fuzz"))


def test_the_file_that_is_damaged_is_good(reader):
    reader.path.write_bytes(reader.valid)
    assert reader.read() is not None


@settings(max_examples=60, derandomize=True, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_damaged_file_is_refused_in_one_line_or_read(reader, seed):
    _, data = damaged(reader, random.Random(seed))
    reader.path.write_bytes(data)
    try:
        reader.read()
    except JiggleError as failure:
        assert "\n" not in str(failure) and len(str(failure)) <= MAX_MESSAGE
    else:
        assert reader.path.exists()
