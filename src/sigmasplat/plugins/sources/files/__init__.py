"""Find, pair and decode the files of a recording."""
