"""How far a value of a profile can be trusted."""

from typing import Literal

# adopted: the project's convention; published: in a refereed paper or a report of the observatory;
# unverified: seen in public code or headers only; assumed: a starting point that does little harm if wrong
Status = Literal["adopted", "published", "unverified", "assumed"]
