"""pyserial URL handlers.  A program that knows nothing of Station opens sim:// and replay:// after one line:

    serial.protocol_handler_packages.append("station.device.urls")
"""
