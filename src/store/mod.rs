//! Everything that lasts, behind one type; the only floor that knows SQL.
