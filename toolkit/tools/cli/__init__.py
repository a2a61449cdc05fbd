"""The programs of `semsplat`: their options, messages and exit status."""
