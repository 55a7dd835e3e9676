from tests.reference.bin import tiles_of  # noqa: F401
