"""Caches of what is used several times."""

import numpy as np

from toolkit.base.caching import ImageStore, LruCache


def test_what_was_not_used_for_longest_is_dropped():
    computed = []
    cache = LruCache(2)

    def value(key):
        return cache.get(key, lambda: computed.append(key) or key.upper())

    assert [value(key) for key in "abacab"] == ["A", "B", "A", "C", "A", "B"]
    assert computed == ["a", "b", "c", "b"]


def test_values_of_replaced_sources_are_computed_again():
    cache, source = LruCache(2), [1, 2]
    assert cache.get("sum", lambda: sum(source), (source,)) == 3
    assert cache.get("sum", lambda: 0, (source,)) == 3
    assert cache.get("sum", lambda: 4, ([1, 2],)) == 4  # an equal list, but another one


def test_images_are_kept_while_there_is_room():
    read = []
    store = ImageStore(max_bytes=30)

    def image(key, keep=True):
        found = (np.zeros(10, np.uint8), np.zeros(2, np.uint8))
        return store.get(key, lambda: read.append(key) or found, keep)

    for key in "abcabc":
        image(key)
    assert read == ["a", "b", "c", "c"]
    store.clear()
    image("c", keep=False)
    image("c")
    image("c")
    assert read[4:] == ["c", "c"]
