"""The sample city and a device, as the system tests have them."""

from tests.system.conftest import city, item_device

__all__ = ["city", "item_device"]
