"""Tasks on a Ray cluster; the only import of ray."""
