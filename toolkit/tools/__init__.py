"""What people start: programs of the command line, the service, and the viewers.

Knows: arguments, help and exit statuses (`cli`); requests and tools of assistants (`serving`);
pages, streams and recordings that show a map (`viewer`).
In: words of a command line, requests, a run folder. Out: lines, answers, pages.
For others: nothing imports this room.
"""
