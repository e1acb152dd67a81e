"""Oriental Motor AZ drives, over Modbus RTU."""
