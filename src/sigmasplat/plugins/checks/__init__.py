"""Check before you spend time on a run: is the installation healthy, and is a recording usable?

- `installation`: what `sigmasplat doctor` checks: versions, kernels, CUDA, a self-test.
- `recording`: what `sigmasplat inspect` reports about a recording before a run.
- `registration`: the part of `recording` that compares depth outlines with image edges.
- `motion`: the part that compares consecutive frames; `timing`: the part that checks times, also before a run.
"""
