//! The gRPC transport of `sightfix.v1` over [`crate::app`].

/// Messages, services and clients generated from `proto/`.
#[expect(clippy::allow_attributes, reason = "generated code")]
pub mod proto {
    tonic::include_proto!("sightfix.v1");

    /// The descriptors of all files of `proto/`, for server reflection.
    pub const FILE_DESCRIPTOR_SET: &[u8] = tonic::include_file_descriptor_set!("sightfix_descriptor");
}

#[cfg(test)]
mod tests {
    use prost::Message as _;

    #[test]
    fn every_service_can_be_reflected() {
        let set =
            prost_types::FileDescriptorSet::decode(super::proto::FILE_DESCRIPTOR_SET).expect("descriptors");
        let services = set.file.iter().flat_map(|file| &file.service);
        let names: Vec<&str> = services.map(prost_types::ServiceDescriptorProto::name).collect();
        let own = ["CameraService", "SampleService", "TrainingService", "ModelService", "FusionService"];
        assert_eq!(names, own);
    }
}
