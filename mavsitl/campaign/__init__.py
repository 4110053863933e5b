"""Many whole flights in memory: a grid of cases, flown by processes here or by a Dask cluster, each one kept.

    with workers.local(2) as here:
        for row in workers.fly_all(cases, here):
            ...

`mavsitl sweep` and `mavsitl tune` are made of it, and so are the project's own experiments.
"""
