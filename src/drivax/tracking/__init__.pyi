from .checkpoints import Checkpoints as Checkpoints
from .progress import Progress as Progress
from .run_folder import RunFolder as RunFolder
from .run_folder import seed_folders as seed_folders
from .sinks import MetricLog as MetricLog
from .sinks import read_rows as read_rows
