"""Logs of any kind as one sequence of messages in the order of time; writing and rotation of MCAP files.

Begin with `log_reader.py`: it gives the frames of both cameras and the samples of wheels and gyro of a log, whatever
its format. `streams.py` finds the cameras and decides between the times of headers and of logging; `log.py` joins the
parts of a log, puts messages into the order of time and says what is missing. The formats stand below: `mcap_file.py`
(whole and cut), `sqlite_bag.py`, `ros1_bag.py` and `image_folder.py`; `open_log.py` tells them apart by their content.
`mcap_writer.py` and `rotating_log.py` write recordings that are bounded.
"""
