"""The PMB filter under a name of its own."""

from typing import Literal

from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.settings import parameter, settings


@settings
class CautiousSettings(PmbSettings):
    """A PMB filter."""

    kind: Literal["cautious"] = parameter("the filter", default="cautious")  # type: ignore[assignment]


SETTINGS = CautiousSettings
