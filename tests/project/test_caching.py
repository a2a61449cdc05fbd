"""The cache of what was used last."""

from toolkit.caching import LruCache


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
