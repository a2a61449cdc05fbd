"""What the benchmarks share: recordings, runs, tables, and the files of results."""
