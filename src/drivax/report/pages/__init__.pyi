from .comparison import write_comparison as write_comparison
from .inspection import write_histograms as write_histograms
from .page import page as page
from .report import write_report as write_report
from .viewer import criticality_html as criticality_html
from .viewer import write_player as write_player
