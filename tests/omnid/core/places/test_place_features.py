"""Features that stay in a file: what is kept in memory of them, and what is counted."""

from __future__ import annotations

import numpy as np

from omnid.core.places.place_features import FeatureStore, PlaceFeatures, StoredFeatures


def features(value: int, count: int = 10) -> PlaceFeatures:
    return PlaceFeatures(np.full((count, 128), value, np.uint8), np.full((count, 3), value, np.float32))


def test_the_features_that_were_used_last_stay_in_bounded_memory() -> None:
    store = FeatureStore(features, 3 * features(0).nbytes)
    for id in (1, 2, 3, 1, 4):  # 4 takes the place of 2, as 1 was used after it
        assert store.of(id).descriptors[0, 0] == id
    assert store.reads == 4 and store.nbytes == 3 * features(0).nbytes
    for id in (1, 3, 4):
        store.of(id)
    assert store.reads == 4
    store.of(2)
    assert store.reads == 5 and store.nbytes == 3 * features(0).nbytes


def test_features_larger_than_the_memory_are_kept_alone() -> None:
    store = FeatureStore(features, 1)
    assert store.of(1) is store.of(1) and store.nbytes == features(1).nbytes
    store.of(2)
    assert store.nbytes == features(2).nbytes


def test_damaged_features_are_none_and_are_counted() -> None:
    store = FeatureStore(lambda id: None if id == 5 else features(id), 10_000)
    assert store.of(5).count == 0 and store.of(6).count == 10
    assert store.counts == {"features_read": 2, "features_unreadable": 1}


def test_rows_are_shifted_of_what_is_in_memory_and_of_what_is_read_later() -> None:
    store = FeatureStore(features, 10_000)
    stored = StoredFeatures(2, 10, store)
    stored.loaded()
    store.shift_rows(0.5)
    assert stored.loaded().views[0].tolist() == [2.0, 2.5, 2.5] == stored.copied().views[0].tolist()
    assert StoredFeatures(3, 10, store).loaded().views[0].tolist() == [3.0, 3.5, 3.5] and stored.nbytes == 0
