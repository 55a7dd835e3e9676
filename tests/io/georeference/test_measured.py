"""What measured positions are before a reconstruction is placed by them."""

from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.io.georeference.adjustment import NotGeoreferenced
from clsplat.io.georeference.crs import map_positions
from clsplat.io.georeference.reconstruction import require_near_gps


@pytest.mark.parametrize("wrong, refused", [(1, False), (4, True)])
def test_gps_that_a_crs_cannot_represent_counts_as_far_away(wrong, refused):
    """One such photo made the median distance unknown, and with it good control points wrong."""
    degrees = np.column_stack([np.full(5, 48.0), 9 + 1e-4 * np.arange(5)])
    centres, _ = map_positions(degrees, np.zeros(5), "EPSG:25832")
    degrees[:wrong] = 0, 100
    images = [SimpleNamespace(name=str(row), projection_center=lambda row=row: centres[row])
              for row in range(5)]
    metadata = {str(row): SimpleNamespace(latitude=place[0], longitude=place[1])
                for row, place in enumerate(degrees)}
    placed = SimpleNamespace(similarity=np.asarray)
    if refused:
        with pytest.raises(NotGeoreferenced, match="place the photos 20000 km from their GPS"):
            require_near_gps(placed, images, metadata, "EPSG:25832")
    else:
        require_near_gps(placed, images, metadata, "EPSG:25832")
