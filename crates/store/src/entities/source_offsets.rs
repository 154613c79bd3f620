//! How far sources have read the partitions of their topics.

use crate::database::Database;
use crate::domain::{ConnectionKey, Durability, Result, SourceOffset};
use crate::query::query;
use crate::rows::connections::read_source_offset;

impl Database {
    pub(crate) async fn source_offsets(&self, key: ConnectionKey) -> Result<Vec<SourceOffset>> {
        let mut reader = self.reader().await?;
        let rows = query(
            "SELECT topic, partition_number, next_offset FROM source_offsets WHERE connection_key = $1 \
             ORDER BY topic, partition_number",
        )
        .bind(key.0)
        .fetch_all(&mut reader)
        .await?;
        rows.iter().map(read_source_offset).collect()
    }

    pub(crate) async fn store_source_offsets(
        &self,
        key: ConnectionKey,
        offsets: &[SourceOffset],
        durability: Durability,
    ) -> Result<()> {
        let mut writer = self.changing(durability).await?;
        let mut transaction = writer.begin().await?;
        for offset in offsets {
            query(
                "INSERT INTO source_offsets (connection_key, topic, partition_number, next_offset) \
                 SELECT key, $1, $2, $3 FROM connections WHERE key = $4 \
                 ON CONFLICT (connection_key, topic, partition_number) DO UPDATE SET next_offset = excluded.next_offset",
            )
            .bind(&offset.topic)
            .bind(offset.partition)
            .bind(offset.next_offset)
            .bind(key.0)
            .execute(&mut transaction).await?;
        }
        transaction.commit().await
    }
}
