"""What things are: taxonomies, labels, their code in a map, and questions about them.

Knows: taxonomies and trees, codes and decoders of labels, `segmenters`, `features` (descriptors of
images), `taxonomy_building`, `lexicon`, and `scene_graph` (objects, relations, rooms, storeys).
In: images, label images, a map with codes. Out: labels, objects, answers.
For others: `taxonomy.Taxonomy`, `labeller`, `query.LabelledMap`, `features`, `factory`.
"""
