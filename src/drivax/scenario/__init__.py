"""What a driving scene is: schema, lane graph, routes, grid index, map queries, store and device bank."""
