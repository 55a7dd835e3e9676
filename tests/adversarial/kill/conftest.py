"""The sample city, as the system tests have it."""

from tests.system.conftest import city

__all__ = ["city"]
