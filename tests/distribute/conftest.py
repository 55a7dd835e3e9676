"""What the tests of the engine share."""

import pytest


@pytest.fixture(autouse=True)
def caches(monkeypatch, tmp_path):
    """A folder of kernel caches for the children of this test alone."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "kernels"))
