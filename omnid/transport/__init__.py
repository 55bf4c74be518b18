"""Messages to and from other programs: CDR bytes, the zenoh bus, names of topics and status entries.

Begin with `topics.py`, the table of what is published and what is taken. `codec.py` converts messages to the bytes of
ROS 2 and back; `session.py` and `bus.py` own the connection. Commands come through bounded rings with budgets,
before any decoding, and `commands.py` (type, bounds, freshness, action). `status_names.py` are the names of
status entries. Whatever arrives is untrusted: it is decoded strictly, and refused with a count.
"""
