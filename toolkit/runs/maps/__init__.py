"""Maps of finished runs: read, labelled, edited, merged, registered and compared."""
