"""What stands where: bodies of objects, relations, rooms, storeys, floor plans, paths, changes."""
