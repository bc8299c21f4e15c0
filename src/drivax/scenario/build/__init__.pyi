from .assemble import assemble as assemble
from .assemble import count_source as count_source
from .lanes import LaneGraph as LaneGraph
from .lanes import lane_graph as lane_graph
from .routes import Route as Route
from .routes import RouteSet as RouteSet
from .routes import RouteStyle as RouteStyle
from .routes import find_routes as find_routes
