"""The swarm as ROS 2 topics, in the form of rmw_zenoh, without ROS."""
