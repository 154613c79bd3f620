//! The files of the crates, and the files that each of them imports from.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Segments of a module's path from its crate on: `["sightfix", "http", "samples"]`, `["model", "encoder"]`.
type ModulePath = Vec<String>;

/// One source file without comments and unit tests.
pub(super) struct SourceFile {
    /// Path below the `src` of its crate.
    pub(super) path: PathBuf,
    module: ModulePath,
    pub(super) text: String,
}

impl SourceFile {
    fn new(package: &str, path: PathBuf, text: String) -> Self {
        let segments = path.with_extension("");
        let segments = segments.components().map(|part| part.as_os_str().to_string_lossy().into_owned());
        let segments = segments.filter(|segment| segment != "mod" && segment != "lib");
        Self { module: std::iter::once(package.to_owned()).chain(segments).collect(), path, text }
    }

    /// The module at the top of the crate that the file belongs to; empty for the crate's own file.
    pub(super) fn top_level(&self) -> &str {
        self.module.get(1).map_or("", String::as_str)
    }

    /// All paths in the file that begin with `crate`, `super` or `self`, or, in a `use`, with a submodule.
    fn paths(&self, submodules: &BTreeSet<&ModulePath>) -> Vec<ModulePath> {
        let mut paths = Vec::new();
        for root in ["crate::", "super::", "self::"] {
            for (at, _) in self.text.match_indices(root) {
                let is_start =
                    !self.text[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':');
                if is_start {
                    paths.extend(use_tree(&self.text[at..]).0);
                }
            }
        }
        let absolute = |path: ModulePath| self.absolute(path);
        let mut absolute: Vec<ModulePath> = paths.into_iter().filter_map(absolute).collect();
        for (at, start) in self.text.match_indices("use ") {
            for path in use_tree(&self.text[at + start.len()..]).0 {
                let relative = [self.module.clone(), path].concat();
                if submodules
                    .iter()
                    .any(|submodule| relative.starts_with(submodule) && submodule.len() > self.module.len())
                {
                    absolute.push(relative);
                }
            }
        }
        absolute
    }

    /// The path from the crate on; `None` for a path that leaves it.
    fn absolute(&self, path: ModulePath) -> Option<ModulePath> {
        let mut absolute = if path[0] == "crate" { self.module[..1].to_vec() } else { self.module.clone() };
        for segment in path {
            match segment.as_str() {
                "crate" | "self" => {}
                "super" => drop(absolute.pop()?),
                _ => absolute.push(segment),
            }
        }
        Some(absolute)
    }
}

/// The paths of a use tree (`a::{b, c::d}`) at the beginning of a text, and the text after it.
fn use_tree(text: &str) -> (Vec<ModulePath>, &str) {
    let text = text.trim_start();
    if let Some(mut rest) = text.strip_prefix('{') {
        let mut paths = Vec::new();
        loop {
            let (branch, after) = use_tree(rest);
            paths.extend(branch);
            rest = after.trim_start();
            match rest.strip_prefix(',') {
                Some(after) if after.trim_start().starts_with('}') => {
                    return (paths, &after.trim_start()[1..]);
                }
                Some(after) => rest = after,
                None => return (paths, rest.strip_prefix('}').unwrap_or(rest)),
            }
        }
    }
    let end = text.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(text.len());
    let (segment, rest) = (text[..end].to_owned(), &text[end..]);
    match rest.strip_prefix("::") {
        Some(below) if below.starts_with(|c: char| c.is_alphabetic() || c == '_' || c == '{') => {
            let (paths, rest) = use_tree(below);
            let prefixed = paths.into_iter().map(|path| [vec![segment.clone()], path].concat());
            (prefixed.collect(), rest)
        }
        _ => (vec![vec![segment]], rest),
    }
}

/// All files of the crate at the top.
pub(super) fn files_of_src() -> Vec<SourceFile> {
    files_of("sightfix", Path::new(env!("CARGO_MANIFEST_DIR")))
}

/// All files of the workspace.
pub(super) fn files_of_all_crates() -> Vec<SourceFile> {
    let crates = Path::new(env!("CARGO_MANIFEST_DIR")).join("crates");
    let mut files = files_of_src();
    for entry in fs::read_dir(crates).expect("the crates can be read") {
        let entry = entry.expect("an entry can be read");
        files.extend(files_of(&entry.file_name().to_string_lossy(), &entry.path()));
    }
    files
}

fn files_of(package: &str, folder: &Path) -> Vec<SourceFile> {
    let root = folder.join("src");
    let mut folders = vec![root.clone()];
    let mut files = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).expect("src can be read") {
            let path = entry.expect("an entry can be read").path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let text = fs::read_to_string(&path).expect("source can be read");
                let path = path.strip_prefix(&root).expect("below src").to_owned();
                let text = without_comments(&without_tests(&path, text));
                files.push(SourceFile::new(package, path, text));
            }
        }
    }
    files
}

/// Unit tests may import from higher layers: a filter is tested on a simulation.
fn without_tests(path: &Path, text: String) -> String {
    if path.components().any(|part| matches!(part.as_os_str().to_str(), Some("tests" | "tests.rs"))) {
        return String::new();
    }
    match text.find("\n#[cfg(test)]\nmod tests {") {
        Some(end) => text[..end].to_owned(),
        None => text,
    }
}

fn without_comments(text: &str) -> String {
    let line =
        |line: &str| if line.trim_start().starts_with("//") { "\n".to_owned() } else { format!("{line}\n") };
    text.lines().map(line).collect()
}

/// The files that each file imports from, within the same crate, by index.
///
/// A name that a module re-exports from a submodule counts as imported from the submodule. What a file
/// imports from a module that contains it is not counted: a submodule may use the types of its parent.
pub(super) fn imports_within_crates(files: &[SourceFile]) -> Vec<BTreeSet<usize>> {
    let modules: BTreeSet<&ModulePath> = files.iter().map(|file| &file.module).collect();
    let by_module: BTreeMap<&ModulePath, usize> =
        files.iter().enumerate().map(|(index, file)| (&file.module, index)).collect();
    let re_exports = re_exports(files, &modules);
    let resolve = |path: ModulePath| {
        let mut path = path;
        while let Some(target) = re_exports.get(&path) {
            path.clone_from(target);
        }
        (0..=path.len()).rev().find_map(|length| by_module.get(&path[..length].to_vec()).copied())
    };
    let imports = |(index, file): (usize, &SourceFile)| {
        let targets = file.paths(&modules).into_iter().filter_map(resolve);
        let counted = |target: &usize| {
            let module = &files[*target].module;
            *target != index && module[0] == file.module[0] && !file.module.starts_with(module)
        };
        targets.filter(counted).collect()
    };
    files.iter().enumerate().map(imports).collect()
}

/// Re-exported names with the path that they stand for.
fn re_exports(files: &[SourceFile], modules: &BTreeSet<&ModulePath>) -> BTreeMap<ModulePath, ModulePath> {
    let mut re_exports = BTreeMap::new();
    for file in files {
        for start in ["pub use ", "pub(crate) use ", "pub(super) use "] {
            for (at, _) in file.text.match_indices(start) {
                for path in use_tree(&file.text[at + start.len()..]).0 {
                    let relative = [file.module.clone(), path.clone()].concat();
                    let is_submodule = modules.contains(&relative[..=file.module.len()].to_vec());
                    let target = if is_submodule { Some(relative) } else { file.absolute(path.clone()) };
                    let name = [file.module.clone(), path[path.len() - 1..].to_vec()].concat();
                    if let Some(target) = target.filter(|target| *target != name) {
                        re_exports.insert(name, target);
                    }
                }
            }
        }
    }
    re_exports
}

/// A circle of imports, as indexes of files, if there is one.
pub(super) fn circle(imports: &[BTreeSet<usize>]) -> Option<Vec<usize>> {
    /// Follows the imports of the last file of a chain.
    fn follow(
        imports: &[BTreeSet<usize>],
        chain: &mut Vec<usize>,
        done: &mut BTreeSet<usize>,
    ) -> Option<Vec<usize>> {
        let last = *chain.last()?;
        for &next in &imports[last] {
            if let Some(start) = chain.iter().position(|file| *file == next) {
                return Some(chain[start..].to_vec());
            }
            if !done.contains(&next) {
                chain.push(next);
                if let Some(circle) = follow(imports, chain, done) {
                    return Some(circle);
                }
                chain.pop();
            }
        }
        done.insert(last);
        None
    }
    let mut done = BTreeSet::new();
    (0..imports.len()).find_map(|start| follow(imports, &mut vec![start], &mut done))
}

#[test]
fn a_use_tree_is_expanded_to_its_paths() {
    let (paths, rest) = use_tree("super::{a::{B, c}, D,\n};\nrest");
    let paths: Vec<String> = paths.iter().map(|path| path.join("::")).collect();
    assert_eq!(
        (paths.as_slice(), rest),
        (&["super::a::B", "super::a::c", "super::D"].map(String::from)[..], ";\nrest")
    );
    let (paths, rest) = use_tree("crate::model::fit(&samples)");
    assert_eq!((paths, rest), (vec![["crate", "model", "fit"].map(String::from).to_vec()], "(&samples)"));
}

#[test]
fn a_circle_is_found_through_a_re_export() {
    let file = |path: &str, text: &str| SourceFile::new("house", PathBuf::from(path), text.to_owned());
    let files = [
        file("rooms/mod.rs", "mod low;\nmod high;\npub use high::Roof;\n"),
        file("rooms/low.rs", "use super::Roof;\n"),
        file("rooms/high.rs", "use super::low::Floor;\n"),
    ];
    let imports = imports_within_crates(&files);
    assert_eq!(circle(&imports).map(|circle| circle.len()), Some(2), "{imports:?}");
    let without = [file("rooms/low.rs", ""), file("rooms/high.rs", "use super::low::Floor;\n")];
    assert_eq!(circle(&imports_within_crates(&without)), None);
}
