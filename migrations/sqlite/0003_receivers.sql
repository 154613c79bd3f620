-- JSON: [{"receiver_id": text, "target_id": text, "clock_offset_us": integer}]
ALTER TABLE cameras ADD COLUMN receivers TEXT NOT NULL DEFAULT '[]';
