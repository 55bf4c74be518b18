"""Codes of features, and votes by them among many keyframes."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.places.code_index import INDEXED, CodeIndex, azimuths_of, codes_of
from omnid.core.places.code_kernels import BINS, TURN, count_votes
from omnid.core.places.place_features import PlaceFeatures

WIDTH = 600


def some_features(rng: np.random.Generator, count: int = INDEXED) -> PlaceFeatures:
    views = rng.uniform(0, WIDTH, (count, 3)).astype(np.float32)
    return PlaceFeatures(rng.integers(0, 256, (count, 128), dtype=np.uint8), views)


def index_of(keyframes: dict[int, PlaceFeatures]) -> CodeIndex:
    return CodeIndex(
        np.array(list(keyframes)),
        np.array([min(one.count, INDEXED) for one in keyframes.values()]),
        np.concatenate([codes_of(one) for one in keyframes.values()]),
        np.concatenate([azimuths_of(one, WIDTH) for one in keyframes.values()]),
    )


def test_a_bit_of_a_code_is_the_sign_of_a_sum_with_signs() -> None:
    """As OMAP.md says it, computed one value at a time."""
    features = some_features(np.random.default_rng(1), 3)
    for code, descriptor in zip(codes_of(features).tolist(), features.descriptors.tolist(), strict=True):
        for i in (1, 2, 37, 64):
            total = sum((-1) ** (i & j).bit_count() * value for j, value in enumerate(descriptor))
            assert code >> (i - 1) & 1 == (total > 0)


def test_azimuths_are_bytes_of_the_full_turn() -> None:
    views = np.float32([[-150, 0, 1], [0, 0, 1], [WIDTH / 2, 0, 1], [WIDTH - 1e-3, 0, 1], [WIDTH, 0, 1]])
    assert azimuths_of(PlaceFeatures(np.zeros((5, 128), np.uint8), views), WIDTH).tolist() == [192, 0, 128, 255, 0]


@pytest.mark.parametrize("most", [1, 2, 20, 50])
def test_votes_are_those_of_a_plain_search(most: int) -> None:
    rng = np.random.default_rng(2)
    counts = [0, 1, 30, 50]
    codes, azimuths = rng.integers(0, 1 << 63, 81, dtype=np.uint64), rng.integers(0, 256, 81).astype(np.uint8)
    here = np.concatenate([codes[40:56] ^ np.uint64(0b1011), codes[2:6]])
    turns = np.concatenate([azimuths[40:56] + np.uint8(70), azimuths[2:6]])
    starts, rows = np.concatenate([[0], np.cumsum(counts)]), np.array([3, 0, 1, 2])
    votes = np.full(4, -1, np.int32)
    count_votes(codes, azimuths, starts, rows, here, turns, most, votes)
    for row, found in zip(rows.tolist(), votes.tolist(), strict=True):
        known = range(starts[row], min(starts[row + 1], starts[row] + most))
        bins = [0] * BINS
        for code, azimuth in zip(here.tolist(), turns.tolist(), strict=True):
            ranked = sorted(((int(codes[n]) ^ code).bit_count(), n) for n in known)
            if len(ranked) > 1 and 10 * ranked[0][0] < 8 * ranked[1][0]:
                bins[(azimuth - int(azimuths[ranked[0][1]])) % TURN * BINS // TURN] += 1
        assert found == max(bins[b] + bins[(b + 1) % BINS] + bins[b - 1] for b in range(BINS))
    assert most < 20 or votes[0] > 5


def test_the_keyframe_that_a_frame_shows_comes_first_whatever_the_turn_among_those_that_are_asked_for() -> None:
    rng = np.random.default_rng(3)
    keyframes = {7 * n: some_features(rng, 150) for n in range(200)}
    shown = keyframes[7 * 31]
    noisy = np.clip(shown.descriptors + rng.normal(scale=25, size=shown.descriptors.shape), 0, 255).astype(np.uint8)
    turned = shown.views.copy()
    turned[:, 0] = (turned[:, 0] + 200) % WIDTH
    here, index = PlaceFeatures(noisy, turned), index_of(keyframes)
    ids = np.array(list(keyframes))
    ranked = index.ranked(here, ids, WIDTH)
    assert ranked[0] == 7 * 31 and sorted(ranked) == ids.tolist()
    assert sorted(index.ranked(here, ids[ids != 7 * 31], WIDTH)) == [id for id in ids.tolist() if id != 7 * 31]
    assert index.has(np.array([7, 8, 14])).tolist() == [True, False, True]


def test_a_frame_without_features_is_no_error() -> None:
    index = index_of({1: some_features(np.random.default_rng(4)), 2: some_features(np.random.default_rng(5), 0)})
    nothing = PlaceFeatures(np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32))
    assert sorted(index.ranked(nothing, np.array([1, 2]), WIDTH)) == [1, 2]
