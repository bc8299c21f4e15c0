from .library import in_use as in_use
from .library import state as state
from .library import with_reference as with_reference
from .library import without_kernels as without_kernels
