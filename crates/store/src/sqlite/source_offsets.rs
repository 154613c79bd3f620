//! How far sources have read the partitions of their topics.

use super::Store;
use super::errors::failed;
use crate::domain::{ConnectionKey, Durability, Result, SourceOffset};
use crate::rows::connections::read_source_offset;

impl Store {
    pub(crate) async fn source_offsets(&self, key: ConnectionKey) -> Result<Vec<SourceOffset>> {
        let rows = sqlx::query(
            "SELECT topic, partition_number, next_offset FROM source_offsets WHERE connection_key = ? \
             ORDER BY topic, partition_number",
        )
        .bind(key.0)
        .fetch_all(self.readers())
        .await
        .map_err(failed)?;
        rows.iter().map(read_source_offset).collect()
    }

    pub(crate) async fn store_source_offsets(
        &self,
        key: ConnectionKey,
        offsets: &[SourceOffset],
        durability: Durability,
    ) -> Result<()> {
        let mut writer = match durability {
            Durability::Synced => self.synced().await?,
            Durability::Relaxed => self.relaxed().await?,
        };
        let mut transaction = writer.begin().await?;
        for offset in offsets {
            sqlx::query(
                "INSERT INTO source_offsets (connection_key, topic, partition_number, next_offset) \
                 SELECT key, ?, ?, ? FROM connections WHERE key = ? \
                 ON CONFLICT (connection_key, topic, partition_number) DO UPDATE SET next_offset = excluded.next_offset",
            )
            .bind(&offset.topic)
            .bind(i64::from(offset.partition))
            .bind(offset.next_offset)
            .bind(key.0)
            .execute(&mut *transaction)
            .await
            .map_err(failed)?;
        }
        transaction.commit().await.map_err(failed)
    }
}
