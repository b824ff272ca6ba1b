"""Check before you spend time on a run: is the installation healthy (`installation`), and is a recording usable?

`recording` is what `sigmasplat inspect` reports; `depth` and `motion` are its parts, `motion` also watches a run.
"""
