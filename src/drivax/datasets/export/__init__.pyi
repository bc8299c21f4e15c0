from .recording import restore as restore
from .tfexample import tf_example as tf_example
from .writer import Export as Export
from .writer import Exported as Exported
from .writer import export as export
from .writer import merge as merge
