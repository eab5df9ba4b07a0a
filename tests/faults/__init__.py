"""What can happen to a night's run from outside, and what must be left of it.

``make faults`` kills a run at many random moments and fills its disk at many places;
``tests/test_faults.py`` does a few of these, and what needs to be done only once. Stages are stand-ins
that take no time, so that nearly every moment falls into reading, writing, renaming and book-keeping.
"""
