"""Fewer triangles: flat ones go, corners, colours and open borders stay."""

import numpy as np
import pytest
import skimage

from clsplat.mesh.decimate import decimated, edges_of


def surface_of(distance):
    """Vertices, colours, triangles and no kept ones of the surface of a volume [X, Y, Z]."""
    vertices, triangles, *_ = skimage.measure.marching_cubes(distance, 0)
    return (vertices.astype(float), np.full(vertices.shape, 90.0), triangles, np.zeros(len(vertices), bool))


def box(side=44, low=6.3, high=37.6):
    places = np.stack(np.meshgrid(*3 * [np.arange(side)], indexing="ij"))
    return np.maximum(low - places, places - high).max(axis=0)


def volume_inside(vertices, triangles):
    first, second, third = vertices[triangles].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", first, np.cross(second, third))) / 6


def test_a_box_keeps_its_shape_with_few_triangles():
    whole = surface_of(box())
    vertices, colours, triangles, _ = decimated(*whole)
    assert len(triangles) < 0.35 * len(whole[2]) and len(vertices) < 0.35 * len(whole[0])
    assert (edges_of(triangles)[1] == 2).all(), "it is still closed"
    away = np.maximum(6.3 - vertices, vertices - 37.6).max(axis=1)
    assert abs(away).max() < 0.5
    assert volume_inside(vertices, triangles) == pytest.approx(31.3**3, rel=0.01)
    assert (colours == 90).all()


def test_a_ball_stays_round():
    places = np.stack(np.meshgrid(*3 * [np.arange(52)], indexing="ij"))
    whole = surface_of(np.linalg.norm(places - 25.7, axis=0) - 22)
    vertices, _, triangles, _ = decimated(*whole)
    assert len(triangles) < 0.5 * len(whole[2]) and (edges_of(triangles)[1] == 2).all()
    assert abs(np.linalg.norm(vertices - 25.7, axis=1) - 22).max() < 0.4
    middles = np.linalg.norm(vertices[triangles].mean(axis=1) - 25.7, axis=1)
    assert abs(middles - 22).max() < 1


def test_what_is_kept_stays():
    vertices, colours, triangles, keep = surface_of(box())
    keep[::3] = True
    found, _, _, kept = decimated(vertices, colours, triangles, keep)
    assert np.array_equal(found[kept], vertices[keep]) and kept.sum() == keep.sum()


def test_open_borders_stay():
    vertices, colours, triangles, keep = surface_of(box())
    open_at = vertices[triangles][:, :, 2].max(axis=1) < 30  # the box without its lid
    triangles = triangles[open_at]
    found, _, fewer, _ = decimated(vertices, colours, triangles, keep)
    edges, counts = edges_of(triangles)
    border = vertices[np.unique(edges[counts == 1])]
    edges, counts = edges_of(fewer)
    left = found[np.unique(edges[counts == 1])]
    assert len(fewer) < 0.5 * len(triangles)
    assert np.allclose(np.unique(border, axis=0), np.unique(left, axis=0), atol=1e-9)


def test_colours_stay_apart():
    """A flat surface of two colours keeps the line between them."""
    vertices, colours, triangles, keep = surface_of(box())
    plain = decimated(vertices, colours, triangles, keep)
    colours[vertices[:, 0] > 20.2] = 200
    found, tinted, fewer, _ = decimated(vertices, colours, triangles, keep)
    assert set(np.unique(tinted)) == {90, 200} and len(fewer) > len(plain[2])
    assert ((found[:, 0] > 20.2) == (tinted[:, 0] == 200)).all()
    assert not decimated(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros(0, bool))[2].size


def test_a_flat_sheet_is_not_folded_and_gets_no_holes():
    """Exactly flat, so that large cells become one, beside a border that stays."""
    x, y, z = np.indices((70, 70, 8))
    vertices, triangles, *_ = skimage.measure.marching_cubes(
        (z - 3.0002 + 1e-3 * np.sin(7.0 * x + 3 * y)).astype(np.float32), 0
    )
    found, _, fewer, _ = decimated(
        vertices.astype(float), np.full(vertices.shape, 90.0), triangles, np.zeros(len(vertices), bool)
    )
    assert len(fewer) < 0.3 * len(triangles)
    corners = found[fewer]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert abs(abs(up).sum() - 69**2) < 0.03 * 69**2
    assert min((up < 0).mean(), (up > 0).mean()) < 0.05
    edges, counts = edges_of(fewer)
    border = found[np.unique(edges[counts == 1])][:, :2]
    assert (np.minimum(border, 69 - border).min(axis=1) < 1e-3).all()
