from .bench import BenchConfig as BenchConfig
from .bench import bench_metrics as bench_metrics
from .bench_encoders import EncoderBench as EncoderBench
from .demo import DemoConfig as DemoConfig
from .demo import run_demo as run_demo
from .longtail import study as study
from .longtail_drives import LongtailConfig as LongtailConfig
from .longtail_drives import Sets as Sets
