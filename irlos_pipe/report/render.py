"""Fill a page's template."""

from __future__ import annotations

from typing import Any

import jinja2


def rendered(template: str, **content: Any) -> str:
    """Return the page of a `template` filled with `content`; text is escaped, a missing name is an error."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("irlos_pipe.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(template).render(**content)
