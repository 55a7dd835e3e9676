"""Which pages hold rows, and where these lie; `size` is the number of rows of a page."""

import numpy as np


def wanted_pages(flags, places, pages, size):
    """bool[pages], the pages of the rows whose flag is 1."""
    wanted = np.zeros(pages, bool)
    for row in np.flatnonzero(flags):
        wanted[places[row] // size] = True
    return wanted


def rest_rows(rows, places, slots, size):
    """Where each of the rows lies, if its page has a slot; slots: the slot of each page."""
    return np.array([slots[places[row] // size] * size + places[row] % size for row in rows])
