"""Tracks: connected matches, one point per image."""

import pytest
import torch
from chance import seeded
from hypothesis import given, settings
from hypothesis import strategies as st

from torchsfm.reconstruction.mapping import tracks
from torchsfm.reconstruction.mapping.tracks import _by_priority, build_tracks


def test_chains_become_tracks() -> None:
    view = torch.tensor([0, 0, 1, 1, 2, 2])
    match = torch.tensor([[0, 2], [2, 4], [1, 3]])
    track = build_tracks(view, match)
    assert track.tolist() == [0, 1, 0, 1, 0, -1]


def test_a_contradicting_match_is_left_out_by_priority() -> None:
    # Points 0 and 1 lie in one image; both claim point 2.
    view = torch.tensor([0, 0, 1])
    match = torch.tensor([[0, 2], [1, 2]])
    assert build_tracks(view, match).tolist() == [0, -1, 0]
    assert build_tracks(view, match, torch.tensor([1, 5])).tolist() == [-1, 0, 0]


def test_no_matches() -> None:
    assert build_tracks(torch.tensor([0, 1]), torch.zeros(0, 2, dtype=torch.long)).tolist() == [-1, -1]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 7), st.integers(2, 40), st.integers(0, 80))
def test_laws(seed: int, images: int, points: int, matches: int) -> None:
    g = seeded(seed)
    view = torch.randint(images, (points,), generator=g)
    match = torch.randint(points, (matches, 2), generator=g)
    match = match[view[match[:, 0]] != view[match[:, 1]]]
    track = build_tracks(view, match)
    used = track[track >= 0]
    # Numbered without gaps, at least two points each, never two of one image.
    assert sorted(set(used.tolist())) == list(range(int(used.max()) + 1 if len(used) else 0))
    assert bool((torch.bincount(used) >= 2).all())
    keys = (track * images + view)[track >= 0]
    assert len(torch.unique(keys)) == len(keys)
    # Matches that share no image with any other's component are all honoured when nothing contradicts.
    conflict_free = all(len(set(view[c].tolist())) == len(c) for c in _components(points, match))
    if conflict_free:
        assert bool((track[match[:, 0]] == track[match[:, 1]]).all())


def _components(points: int, match: torch.Tensor) -> list[list[int]]:
    group = list(range(points))
    for _ in range(points):
        for a, b in match.tolist():
            group[a] = group[b] = min(group[a], group[b])
    return [[i for i in range(points) if group[i] == k] for k in set(group)]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 7), st.integers(2, 40), st.integers(0, 60))
def test_matches_that_nothing_contradicts_need_no_order(seed: int, images: int, points: int, matches: int) -> None:
    """Those of tracks without a contradiction are joined at once, as they would be one after the other."""
    g = seeded(seed)
    view = torch.randint(images, (points,), generator=g)
    match = torch.randint(points, (matches, 2), generator=g)
    match = match[view[match[:, 0]] != view[match[:, 1]]]
    priority = torch.randint(5, (len(match),), generator=g)
    root = _by_priority(view, match[torch.argsort(priority, descending=True, stable=True)])
    track = build_tracks(view, match, priority)
    together = track[:, None] == track
    together[track < 0] = torch.eye(points, dtype=torch.bool)[track < 0]
    assert torch.equal(together, root[:, None] == root)


def test_only_contradicted_tracks_are_gone_through_match_by_match(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = []

    def counted(view: torch.Tensor, match: torch.Tensor) -> torch.Tensor:
        taken.append(match.tolist())
        return _by_priority(view, match)

    monkeypatch.setattr(tracks, "_by_priority", counted)
    view = torch.tensor([0, 0, 1, 1, 2])
    match = torch.tensor([[0, 2], [1, 3], [3, 4], [0, 4]])
    build_tracks(view[:4], match[:2])
    assert not taken
    build_tracks(torch.cat((view, view)), torch.cat((match, match[:3] + 5)))
    assert taken == [match.tolist()]
