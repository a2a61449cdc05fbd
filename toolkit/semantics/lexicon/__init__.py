"""Words that are not in a taxonomy: synonyms, kinds, and the matching of both with class names."""
