"""Groups in fields: hosts by id, groups kept whole where blends are cut, and where they are cut."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.fields.blends.cut import Limits, pieces_of
from clresample.fields.blends.plan import host_ids, source_ids
from clresample.fields.blends.tiles import Tile
from clresample.fields.box import Box
from clresample.fields.work.fitting import LARGE, is_large
from clresample.fields.work.rounds import _Parts
from clresample.fields.work.searching import _lost


def chain(saddle, n=4):
    """Light of n peaks along a row, 20 px apart, the saddles between them at a height."""
    x = np.arange(20 * n)
    row = saddle + 100 * np.exp(-(((x % 20) - 10) ** 2) / 8)
    light = np.tile(row, (21, 1)) * np.exp(-((np.arange(21)[:, None] - 10) ** 2) / 200)
    return light, np.array([(10.0, 20 * i + 10.0) for i in range(n)])


@pytest.mark.parametrize("saddle, n_pieces", [(4.0, 4), (12.0, 1)])
def test_costly_blends_part_where_their_light_is_weak(saddle, n_pieces):
    light, places = chain(saddle)
    inside = np.ones(light.shape, bool)
    _, number = pieces_of(light, inside, places, Limits(work=900), 0)
    assert len(set(number.tolist())) == n_pieces
    _, number = pieces_of(light, inside, places, Limits(work=10**6), 0)
    assert set(number.tolist()) == {0}


def test_a_group_stays_in_one_piece():
    light, places = chain(4.0)
    inside = np.ones(light.shape, bool)
    groups = np.array([7, 1, 2, 7])
    _, number = pieces_of(light, inside, places, Limits(work=900), 0, groups)
    assert number[0] == number[3] and len(set(number.tolist())) == 3
    _, number = pieces_of(light, inside, places, Limits(sources=1), 0, groups)
    assert len(set(number.tolist())) == 4


def test_hosts_are_found_by_their_position_and_else_the_brightest_stands_for_them():
    places = np.array([[1.0, 2.0], [5.0, 6.0], [9.0, 9.0], [12.0, 3.0]])
    hosts = np.array([[1.0, 2.0], [1.0, 2.0], [40.0, 40.0], [40.0, 40.0]])
    ids = source_ids(places)
    found = host_ids(places, [9, 4, 3, 8], ids, hosts)
    assert found.tolist() == [ids[0], ids[0], ids[3], ids[3]]


def test_given_sources_of_a_lost_tile_are_kept_and_found_ones_cannot_be():
    tile = Tile(0, Box(0, 0, 40, 50), Box(0, 0, 40, 50))
    found = _lost(tile, np.array([[10.0, 20.0], [70.0, 20.0]]))
    assert found.positions.tolist() == [[10, 20]] and found.lit[10, 20] and not found.lit[10, 40]
    assert not len(_lost(tile, None).positions) and not _lost(tile, None).lit.any()


@pytest.mark.parametrize(
    "flux, error, moves",
    [
        ([100.0, 102.0], 10.0, False),  # 0.2 errors
        ([100.0, 104.0], 10.0, True),  # 0.4 errors, 4 %
        ([1000.0, 1004.0], 1.0, False),  # 4 errors, 0.4 %
        ([1000.0, 1008.0], 1.0, True),
    ],
)
def test_a_piece_moves_by_errors_and_by_part_of_its_flux(monkeypatch, flux, error, moves):
    parts = _Parts(SimpleNamespace())
    parts.names = {3: ["first", "second"]}
    monkeypatch.setattr(
        parts,
        "_fluxes",
        lambda pairs: {1: (3, np.array([flux[pairs[0][1] == "second"]]), np.array([error]))},
    )
    assert parts.moved({3}) == ({3} if moves else set())


def test_a_large_piece_has_many_pixels_times_sources():
    def patch(n, side):
        return SimpleNamespace(box=Box(0, 0, side, side), sources=tuple(range(n)))

    assert is_large(patch(20, 200)) and not is_large(patch(2, 200))
    assert LARGE == 500_000
