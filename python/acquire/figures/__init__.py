"""Pictures of materials on a statue: ``python -m acquire.figures``.

Needs ``pip install "./python[mitsuba,figures]"``. ``docs/rendering.md`` of the repository shows what it makes.
"""
