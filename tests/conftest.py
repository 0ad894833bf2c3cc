"""Settings for all tests: property tests are repeatable, and no slow machine fails them by its clock."""

from hypothesis import settings

settings.register_profile("station", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("station")
