"""What stands where: objects, their relations, rooms and storeys, and questions about them.

Knows: `instances` (objects by masks), `growing` (a scene graph during the run), `graph` (bodies,
relations, rooms, storeys, paths, changes of labelled maps), `query` and `object_search`.
In: keyframes of a run, which it is told of, or a labelled map. Out: objects, graphs, answers.
For others: `query`, `object_search`, `graph`, `growing.listener`, `growing.options`,
`instances.factory`, `instances.ignoring`, `instances.listener`, `instances.options`,
`instances.result`, `instances.saved`, `instances.tracking`.
"""
