from .curves import chart as chart
from .curves import curve_sections as curve_sections
from .distributions import distribution_charts as distribution_charts
from .distributions import histogram as histogram
from .motion import signals as signals
