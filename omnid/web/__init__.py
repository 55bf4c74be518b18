"""`omnid web`: a page about a robot, served by a process of its own that subscribes to the bus.

Begin with `server.py`: tokens, cookies and origins, the routes of HTTP, and `/metrics`. `feed.py` holds the newest
state of the robot and gives each browser what is new to it, `robot.py` asks the robot (stop, arm, goals, routes).
`static/` is the page itself, without a framework and without the internet. What browsers do cannot delay the daemon.
"""
