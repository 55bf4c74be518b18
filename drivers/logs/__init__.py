"""Logs of any kind as one sequence of messages in the order of time; writing and rotation of MCAP files.

Begin with `log_reader.py`: it gives the frames of both cameras and the samples of wheels and gyro of a log, whatever
its format, which it chooses by the content; it finds the cameras and decides between the times of headers and of
logging. `log.py` joins the parts of a log, puts messages into the order of time and reports what is missing. The
formats are `mcap_file.py` (whole and cut), `bags.py` and `image_folder.py`. `mcap_writer.py` writes recordings, which
are bounded.
"""
