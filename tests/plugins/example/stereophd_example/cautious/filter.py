"""The filter of the settings beside it."""

from stereophd.core.multi.pmb.filter import PmbFilter

FILTER = PmbFilter
