"""Images that hang together: pairs across are counted all together."""

import torch
from torch import Tensor

from torchsfm.reconstruction.evidence.consistency import PairAgreement
from torchsfm.reconstruction.evidence.groups import agreeing_groups, hanging_groups, outvoted_groups


def two_sides(sizes: tuple[int, int], agree_across: int, generator: torch.Generator) -> PairAgreement:
    """All pairs of images, those of each side agree, with 60 to 200 matches; across, all but some contradict, with 50 each."""
    side = torch.arange(sum(sizes)) >= sizes[0]
    pairs = torch.combinations(torch.arange(len(side)))
    agrees = side[pairs[:, 0]] == side[pairs[:, 1]]
    matches = torch.where(agrees, torch.randint(60, 200, (len(pairs),), generator=generator), 50)
    across = (~agrees).nonzero()[:, 0]
    agrees[across[torch.randperm(len(across), generator=generator)[:agree_across]]] = True
    agreeing = torch.where(agrees, matches, 0)
    return PairAgreement(pairs, matches, agreeing, torch.arange(len(pairs)), agreeing)


def shuffled(agreement: PairAgreement, views: int, generator: torch.Generator) -> tuple[PairAgreement, Tensor]:
    """The same with images and pairs in another order, and where each image has gone."""
    place, order = torch.randperm(views, generator=generator), torch.randperm(len(agreement.pairs), generator=generator)
    pairs = place[agreement.pairs].sort(dim=1).values[order]
    matches, agreeing = agreement.matches[order], agreement.agreeing[order]
    return PairAgreement(pairs, matches, agreeing, torch.arange(len(order)), agreeing), place


def test_what_most_matches_across_contradict_is_parted(generator: torch.Generator) -> None:
    for _ in range(10):
        # Of 28 pairs across; any one that agrees joins what is judged by single pairs.
        agreement, place = shuffled(two_sides((7, 4), 4, generator), 11, generator)
        group = agreeing_groups(agreement, 11)[place]
        assert len(group[:7].unique()) == len(group[7:].unique()) == 1
        assert group[0] != group[7]
        out = outvoted_groups(agreement, torch.ones(11, dtype=torch.bool))[place]
        assert out.tolist() == [False] * 7 + [True] * 4


def test_what_most_matches_across_join_is_one(generator: torch.Generator) -> None:
    for _ in range(10):
        agreement, _ = shuffled(two_sides((7, 4), 24, generator), 11, generator)
        assert len(agreeing_groups(agreement, 11).unique()) == 1
        assert not outvoted_groups(agreement, torch.ones(11, dtype=torch.bool)).any()


def test_images_of_which_nothing_is_known_are_no_group_that_is_outvoted(generator: torch.Generator) -> None:
    agreement = two_sides((7, 0), 0, generator)
    registered = torch.ones(12, dtype=torch.bool)
    assert not outvoted_groups(agreement, registered).any()
    assert not outvoted_groups(agreement, torch.zeros_like(registered)).any()
    none = torch.zeros(0, dtype=torch.long)
    assert not outvoted_groups(PairAgreement(none.reshape(0, 2), none, none, none, none), registered).any()


def test_what_a_hinge_holds_is_told(generator: torch.Generator) -> None:
    registered = torch.arange(13) < 12
    for across, held in ((0, False), (1, False), (2, True)):
        agreement, place = shuffled(two_sides((7, 4), across, generator), 11, generator)
        far = (place.argsort() >= 7)[agreement.pairs]
        hinge = agreement.supports & (far[:, 0] != far[:, 1]) & (across == 1)
        found = hanging_groups(agreement, registered, hinge)
        assert found[place].tolist() == ([0] * 11 if held else [0] * 7 + [4] * 4)
        assert found[11:].tolist() == [1, 0], "an image without pairs, and one that is not registered"
