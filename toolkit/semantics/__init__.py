"""What things are: taxonomies, labels, their code in a map, and questions about them.

Knows: taxonomies and trees, codes and decoders of labels, `segmenters`, `features` (descriptors of
images), `taxonomy_building`, `lexicon`.
In: images, label images, features of Gaussians. Out: labels and trees of them.
For others: `taxonomy`, `taxonomy_parsing`, `taxonomy_text`, `taxonomy_drawing`, `trees`,
`labeller`, `factory`, `options`, `codes`, `decoder`, `decoding`, `palette`, `histograms`,
`colour_names`, `embedding_fusion`, `product_quantisation`, `lexicon.matching`, and what `features`,
`segmenters` and `taxonomy_building` contain.
"""
