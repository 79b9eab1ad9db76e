"""Groups in fields: hosts by id, groups kept whole where blends are cut, and where they are cut."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.ended import Ended
from clresample.deblending.settings import Settings
from clresample.fields.blends.cut import FitLimits, cut_blend
from clresample.fields.blends.plan import host_ids, source_ids
from clresample.fields.blends.tiles import SearchTile
from clresample.fields.execution import fitting, rounds
from clresample.fields.execution.fitting import LARGE, _settings, is_large
from clresample.fields.execution.group_results import FOUND_COLUMNS, GroupResults, GroupResultsFile
from clresample.fields.execution.rounds import _PieceHistory
from clresample.fields.execution.searching import _lost
from clresample.paper.settings import PaperSettings
from clresample.sky.box import Box
from clresample.sky.sources import ExtendedSource

EMPTY = np.zeros(0)


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
    _, number = cut_blend(light, inside, places, FitLimits(work=900), 0)
    assert len(set(number.tolist())) == n_pieces
    _, number = cut_blend(light, inside, places, FitLimits(work=10**6), 0)
    assert set(number.tolist()) == {0}


def test_a_group_stays_in_one_piece():
    light, places = chain(4.0)
    inside = np.ones(light.shape, bool)
    groups = np.array([7, 1, 2, 7])
    _, number = cut_blend(light, inside, places, FitLimits(work=900), 0, groups)
    assert number[0] == number[3] and len(set(number.tolist())) == 3
    _, number = cut_blend(light, inside, places, FitLimits(max_sources=1), 0, groups)
    assert len(set(number.tolist())) == 4


def test_hosts_are_found_by_their_position_and_else_the_brightest_stands_for_them():
    places = np.array([[1.0, 2.0], [5.0, 6.0], [9.0, 9.0], [12.0, 3.0]])
    hosts = np.array([[1.0, 2.0], [1.0, 2.0], [40.0, 40.0], [40.0, 40.0]])
    ids = source_ids(places)
    found = host_ids(places, [9, 4, 3, 8], ids, hosts)
    assert found.tolist() == [ids[0], ids[0], ids[3], ids[3]]


def test_given_sources_of_a_lost_tile_are_kept_and_found_ones_cannot_be():
    tile = SearchTile(0, Box(0, 0, 40, 50), Box(0, 0, 40, 50))
    found = _lost(tile, np.array([[10.0, 20.0], [70.0, 20.0]]))
    assert (
        found.positions.tolist() == [[10, 20]]
        and found.footprint_mask[10, 20]
        and not found.footprint_mask[10, 40]
    )
    assert not len(_lost(tile, None).positions) and not _lost(tile, None).footprint_mask.any()


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
    parts = _PieceHistory(SimpleNamespace())
    parts.names = {3: ["first", "second"]}
    monkeypatch.setattr(
        parts,
        "_fluxes",
        lambda pairs: {1: (3, np.array([flux[pairs[0][1] == "second"]]), np.array([error]))},
    )
    assert parts.moved({3}) == ({3} if moves else set())


@pytest.mark.parametrize(
    ("light", "large", "moves", "fitted", "unsettled"),
    [
        # 1 is fainter than both others, and none of these moves
        ((3, 1, 2), {}, [{1}, set()], [{1}, {0, 2}], set()),
        # both move, and 1 is fitted once more
        ((3, 1, 2), {}, [{1}, {0, 2}, set()], [{1}, {0, 2}, {1}], set()),
        # each has the last light of the one before
        ((1, 2, 3), {}, [{0}, {1}, set()], [{0}, {1}, {0, 2}], set()),
        # 0 has its only fit before 1 moves for the last time
        ((1, 2, 3), {0}, [{0}, {1}, {2}, {1}, set()], [{0}, {1}, {2}, {1}, {2}], {70}),
        ((1, 2, 3), {0, 1, 2}, [{0}, {1}, {2}], [{0}, {1}, {2}], set()),
        ((1, 2), {}, [{0, 1}], [{0}, {1}] * 4, {70}),
    ],
)
def test_of_neighbours_the_fainter_is_fitted_first(
    monkeypatch, tmp_path, light, large, moves, fitted, unsettled
):
    """Piece 1 is beside 0 and 2; the last of `moves` repeats. Rough fits are not compared with."""
    siblings = ((1,), (0, 2), (1,)) if len(light) == 3 else ((1,), (0,))
    plan = plan_of(siblings, [70] * len(light), (tuple(range(len(light))),))
    found = rounds_of(monkeypatch, tmp_path, plan, large, moves, light)
    assert found == (fitted, unsettled)


def test_pieces_that_have_not_settled_are_named_though_others_go_on(monkeypatch, tmp_path):
    """0 and 1 move to their last round; 2 moves once."""
    plan = plan_of(((1,), (0,), (3,), (2,)), (70, 70, 80, 80), ((0, 1), (2, 3)))
    moves = [{0, 2}, {1, 3}, {0, 2}, {0, 1}]
    fitted, unsettled = rounds_of(monkeypatch, tmp_path, plan, {}, moves, (1, 2, 3, 4))
    assert fitted[:3] == [{0, 2}, {1, 3}, {0, 2}] and unsettled == {70}


def plan_of(siblings, parents, cut_groups):
    """A plan of one group of patches, which are all cut."""
    patches = [
        SimpleNamespace(siblings=own, pieces=3, parent=parent)
        for own, parent in zip(siblings, parents, strict=True)
    ]
    groups = (tuple(range(len(patches))),)
    return SimpleNamespace(patches=patches, groups=groups, cut_groups=cut_groups)


def rounds_of(monkeypatch, tmp_path, plan, large, moves, light):
    """The pieces fitted again in each round, and the parents that have not settled."""
    done, left = [], list(moves)

    def moved(self, pieces):
        return pieces & (left.pop(0) if len(left) > 1 else left[0])

    def fit_round(_job, tasks, _engine, _progress):
        done.append({n for task in tasks for n in task.patches})
        return {task.name: task.patches for task in tasks}

    monkeypatch.setattr(rounds, "_fit_round", fit_round)
    monkeypatch.setattr(rounds, "_is_large", lambda _job, n: n in large)
    monkeypatch.setattr(_PieceHistory, "moved", moved)
    rough = {n: (n, np.array([float(flux)]), None) for n, flux in enumerate(light)}
    monkeypatch.setattr(_PieceHistory, "_fluxes", lambda self, pairs: rough)
    monkeypatch.setattr(GroupResultsFile, "read", lambda *_: [dict.fromkeys(FOUND_COLUMNS, EMPTY)])
    job = SimpleNamespace(plan=plan, folder=tmp_path)
    progress = SimpleNamespace(stage=lambda *_: None)
    _, unsettled = rounds.fit_all_groups(job, None, progress)
    return done[1:], unsettled


def test_a_large_piece_has_many_pixels_times_sources():
    assert is_large(20, (250, 160)) and not is_large(2, (250, 160))
    assert LARGE == 500_000


@pytest.mark.parametrize(
    "rough, large, continued, given, most, errors",
    [
        (True, False, False, {}, 60, False),
        (True, True, False, {}, 60, False),
        (False, True, False, {}, 150, True),
        (False, True, True, {}, 100, True),
        (False, False, True, {}, 500, True),
        (True, False, False, {"max_iter": 10}, 10, False),
    ],
)
def test_rough_and_large_fits_have_few_iterations(rough, large, continued, given, most, errors):
    settings = _settings(SimpleNamespace(settings=Settings(**given)), rough, large, continued)
    assert (settings.max_iter, settings.errors) == (most, errors)
    assert settings.loss_tol == Settings.loss_tol * (25 if rough else 1)
    paper = PaperSettings()
    assert _settings(SimpleNamespace(settings=paper), rough, large, continued) is paper


@pytest.mark.parametrize("siblings, fitted, left", [((), 1, 0), ((1,), 0, 1)])
def test_what_is_found_beside_pieces_is_left_for_the_next_round(
    monkeypatch, siblings, fitted, left
):
    """A blend that is whole is fitted again at once; only the first round searches."""
    patch = SimpleNamespace(number=3, siblings=siblings, box=Box(10, 20, 40, 50), sources=(0,))
    known = ExtendedSource(position_px=(9, 9), name="76")
    cut = fitting._BlendCutout(patch, fitting.Blend((), (known,), None), {}, 0.0)
    row, blends = (77, 15.0, 27.0, 5), []
    seen = SimpleNamespace(weights=np.ones((1, 10, 10)))
    good, bad = (
        SimpleNamespace(
            observations=[seen],
            losses=[2, x],
            status=Ended.CONVERGED,
            sources=(known,),
            thetas=(("its profile",),),
            structures=(("its structure",),),
        )
        for x in (4900.0, 5100.0)
    )
    monkeypatch.setattr(fitting, "_found", lambda *given: [row])
    first = []

    def fits(job, some, rough):
        blends.extend(b for b in some if b is not cut.blend)
        return [first[0] for _ in some]

    monkeypatch.setattr(fitting, "_fits", fits)
    job = SimpleNamespace(passes=2)
    for i in (0, 1):
        part = GroupResults()
        first[:] = [good]
        cuts, _ = fitting._fits_of(job, None, [cut], part, i)
        if i == 1:
            assert not part.found and cuts == [cut]
        else:
            assert part.found == [(3, *row)] * left and cuts[0].more == (row,) * fitted
        first[:] = [bad]
        assert fitting._fits_of(job, None, [cut], part, i)[0] == [cut]
        assert fitting._fits_of(SimpleNamespace(passes=1), None, [cut], part, i)[0] == [cut]
    assert [b.sources[1].position_px for b in blends] == [(5.0, 7.0)] * fitted
    assert [[s.name for s in b.sources] for b in blends] == [["76", "77"]] * fitted
    assert [b.thetas for b in blends] == [(("its profile",), ())] * fitted
    assert [b.structures for b in blends] == [(("its structure",), ())] * fitted


def test_what_was_found_is_carried_from_round_to_round(tmp_path, monkeypatch):
    monkeypatch.setattr(_PieceHistory, "_fluxes", lambda *_: {})
    plan = SimpleNamespace(patches=[])
    parts = _PieceHistory(SimpleNamespace(folder=tmp_path, plan=plan))
    rows = [(3, 77, 15.0, 27.0, 5), (4, 78, 16.5, 2.25, 78)]
    patches = {3: SimpleNamespace(pieces=2), 4: SimpleNamespace(pieces=2)}
    parts.job.plan.patches = patches
    for name, found in (("fit-0-000000", rows), ("fit-1-000000", [])):
        part = GroupResults(found=found)
        (tmp_path / f"{name}.arrays").write_bytes(part.to_bytes())
        parts.add({name: (3, 4)})
    assert parts.found_in((4,)) == (rows[1],) and parts.found_in((3, 4)) == tuple(rows)
    (table,) = GroupResultsFile(tmp_path / "fit-0-000000.arrays").read("FOUND")
    assert table["host"].tolist() == [5, 78]
