// What an FBX file holds as flat tables, which facepipe/importers/fbx/scene.py reads out of the memory of the module.
//
// Values stay as the file has them: ufbx could turn axes and scale units, but rounds every point as it does.
// A span is the address and the number of what it points to; -1 (NONE) stands for no node, mesh or texture.

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "ufbx.h"

#define EXPORT(name) __attribute__((export_name(name)))
#define MOST_DEPTH 512
#define NONE 0xffffffffu

typedef struct { uint32_t at, count; } span;

typedef struct {
	span name, materials;
	uint32_t parent, mesh, bone, hidden;
	double world[12], geometry[12];
} node_row;

typedef struct {
	span name, points, faces, indices, materials, holes, normals, normal_indices, uvs, colors, color_indices, skins, channels;
	uint32_t color_sets, unused;
} mesh_row;

typedef struct { span name, values, indices; } uv_row;
typedef struct { span clusters, vertices, weights; uint32_t method, most; } skin_row;
typedef struct { uint32_t node, unused; double geometry_to_bone[12], bind_to_world[12]; } cluster_row;
typedef struct { span name, keys; double weight; } channel_row;
typedef struct { uint32_t shape, unused; double weight; } key_row;
typedef struct { span name, vertices, offsets, normals, weights; } shape_row;
typedef struct { double value[4]; uint32_t texture, given; } map_row;

enum { MAPS = 14 };
typedef struct { span name; map_row maps[MAPS]; } material_row;

typedef struct {
	span name, relative, absolute, content, uv_set;
	uint32_t wrap_u, wrap_v, layers, unused;
	double uv_to_texture[12];
} texture_row;

typedef struct {
	span name, times, held, moved, other_owner, other_property;
	uint32_t others, unused;
	double begin, end;
} stack_row;
typedef struct { span text; uint32_t count, kind; } warning_row;

typedef struct {
	double unit_meters, frames_per_second;
	uint32_t axes[3], version, lights, cameras, constraints, caches;
	span nodes, meshes, skins, clusters, channels, shapes, materials, textures, stacks, warnings;
} scene_row;

static ufbx_scene *scene;
static scene_row row;
static span failure;

static span text(ufbx_string one) { return (span){ (uint32_t)(size_t)one.data, (uint32_t)one.length }; }
static span blob(ufbx_blob one) { return (span){ (uint32_t)(size_t)one.data, (uint32_t)one.size }; }
#define LIST(list) ((span){ (uint32_t)(size_t)(list).data, (uint32_t)(list).count })
#define ID(element) ((element) ? (element)->typed_id : NONE)

// A table of `count` rows; the module stops where there is no memory.
static void *table(span *to, size_t count, size_t size)
{
	void *rows = calloc(count ? count : 1, size);
	if (!rows) __builtin_trap();
	*to = (span){ (uint32_t)(size_t)rows, (uint32_t)count };
	return rows;
}

#define IDS(to, list) do { \
	uint32_t *ids = table(&(to), (list).count, sizeof(uint32_t)); \
	for (size_t k = 0; k < (list).count; k++) ids[k] = ID((list).data[k]); \
} while (0)

static void matrix(double *to, const ufbx_matrix *from) { memcpy(to, from->cols, 12 * sizeof(double)); }

static void read_nodes(void)
{
	node_row *rows = table(&row.nodes, scene->nodes.count, sizeof(node_row));
	for (size_t i = 0; i < scene->nodes.count; i++) {
		ufbx_node *node = scene->nodes.data[i];
		rows[i].name = text(node->name);
		rows[i].parent = ID(node->parent);
		rows[i].mesh = ID(node->mesh);
		rows[i].bone = node->bone != NULL;
		rows[i].hidden = !node->visible;
		IDS(rows[i].materials, node->materials);
		matrix(rows[i].world, &node->node_to_world);
		matrix(rows[i].geometry, &node->geometry_to_node);
	}
}

static void read_meshes(void)
{
	mesh_row *rows = table(&row.meshes, scene->meshes.count, sizeof(mesh_row));
	for (size_t i = 0; i < scene->meshes.count; i++) {
		ufbx_mesh *mesh = scene->meshes.data[i];
		mesh_row *to = &rows[i];
		to->name = text(mesh->name);
		to->points = LIST(mesh->vertices);
		to->faces = LIST(mesh->faces);
		to->indices = LIST(mesh->vertex_indices);
		to->materials = LIST(mesh->face_material);
		to->holes = LIST(mesh->face_hole);
		to->normals = LIST(mesh->vertex_normal.values);
		to->normal_indices = LIST(mesh->vertex_normal.indices);
		to->colors = LIST(mesh->vertex_color.values);
		to->color_indices = LIST(mesh->vertex_color.indices);
		to->color_sets = (uint32_t)mesh->color_sets.count;
		uv_row *uvs = table(&to->uvs, mesh->uv_sets.count, sizeof(uv_row));
		for (size_t k = 0; k < mesh->uv_sets.count; k++) {
			ufbx_uv_set *set = &mesh->uv_sets.data[k];
			uvs[k] = (uv_row){ text(set->name), LIST(set->vertex_uv.values), LIST(set->vertex_uv.indices) };
		}
		IDS(to->skins, mesh->skin_deformers);
		size_t count = 0;
		for (size_t k = 0; k < mesh->blend_deformers.count; k++) count += mesh->blend_deformers.data[k]->channels.count;
		uint32_t *ids = table(&to->channels, count, sizeof(uint32_t));
		for (size_t k = 0; k < mesh->blend_deformers.count; k++) {
			ufbx_blend_channel_list channels = mesh->blend_deformers.data[k]->channels;
			for (size_t c = 0; c < channels.count; c++) *ids++ = channels.data[c]->typed_id;
		}
	}
}

static void read_deformers(void)
{
	skin_row *skins = table(&row.skins, scene->skin_deformers.count, sizeof(skin_row));
	for (size_t i = 0; i < scene->skin_deformers.count; i++) {
		ufbx_skin_deformer *skin = scene->skin_deformers.data[i];
		IDS(skins[i].clusters, skin->clusters);
		skins[i].vertices = LIST(skin->vertices);
		skins[i].weights = LIST(skin->weights);
		skins[i].method = skin->skinning_method;
		skins[i].most = (uint32_t)skin->max_weights_per_vertex;
	}
	cluster_row *clusters = table(&row.clusters, scene->skin_clusters.count, sizeof(cluster_row));
	for (size_t i = 0; i < scene->skin_clusters.count; i++) {
		ufbx_skin_cluster *cluster = scene->skin_clusters.data[i];
		clusters[i].node = ID(cluster->bone_node);
		matrix(clusters[i].geometry_to_bone, &cluster->geometry_to_bone);
		matrix(clusters[i].bind_to_world, &cluster->bind_to_world);
	}
	channel_row *channels = table(&row.channels, scene->blend_channels.count, sizeof(channel_row));
	for (size_t i = 0; i < scene->blend_channels.count; i++) {
		ufbx_blend_channel *channel = scene->blend_channels.data[i];
		channels[i].name = text(channel->name);
		channels[i].weight = channel->weight;
		key_row *keys = table(&channels[i].keys, channel->keyframes.count, sizeof(key_row));
		for (size_t k = 0; k < channel->keyframes.count; k++) {
			keys[k].shape = ID(channel->keyframes.data[k].shape);
			keys[k].weight = channel->keyframes.data[k].target_weight;
		}
	}
	shape_row *shapes = table(&row.shapes, scene->blend_shapes.count, sizeof(shape_row));
	for (size_t i = 0; i < scene->blend_shapes.count; i++) {
		ufbx_blend_shape *shape = scene->blend_shapes.data[i];
		shapes[i] = (shape_row){ text(shape->name), LIST(shape->offset_vertices), LIST(shape->position_offsets),
			LIST(shape->normal_offsets), LIST(shape->offset_weights) };
	}
}

// The picture file of a texture: of layers the lowest that is one.
static ufbx_texture *picture(ufbx_texture *texture)
{
	if (!texture || texture->type == UFBX_TEXTURE_FILE) return texture;
	return texture->file_textures.count ? texture->file_textures.data[0] : texture;
}

static void read_materials(void)
{
	material_row *rows = table(&row.materials, scene->materials.count, sizeof(material_row));
	for (size_t i = 0; i < scene->materials.count; i++) {
		ufbx_material *material = scene->materials.data[i];
		ufbx_material_pbr_maps *pbr = &material->pbr;
		ufbx_material_fbx_maps *fbx = &material->fbx;
		// in the order of MAPS in scene.py
		ufbx_material_map *maps[MAPS] = { &pbr->base_factor, &pbr->base_color, &pbr->roughness, &pbr->metalness,
			&pbr->emission_factor, &pbr->emission_color, &pbr->opacity, &pbr->normal_map, &pbr->ambient_occlusion,
			&pbr->specular_ior, &fbx->transparency_factor, &fbx->transparency_color, &fbx->bump, &pbr->glossiness };
		rows[i].name = text(material->name);
		for (size_t k = 0; k < MAPS; k++) {
			map_row *to = &rows[i].maps[k];
			memcpy(to->value, &maps[k]->value_vec4, sizeof(to->value));
			to->given = maps[k]->has_value && !maps[k]->feature_disabled;
			to->texture = NONE;
			if (maps[k]->texture && maps[k]->texture_enabled) to->texture = ID(picture(maps[k]->texture));
		}
	}
	texture_row *textures = table(&row.textures, scene->textures.count, sizeof(texture_row));
	for (size_t i = 0; i < scene->textures.count; i++) {
		ufbx_texture *texture = scene->textures.data[i];
		texture_row *to = &textures[i];
		to->name = text(texture->name);
		to->relative = text(texture->relative_filename);
		to->absolute = text(texture->absolute_filename);
		to->content = blob(texture->content);
		to->uv_set = text(texture->uv_set);
		to->wrap_u = texture->wrap_u;
		to->wrap_v = texture->wrap_v;
		to->layers = (uint32_t)texture->layers.count;
		matrix(to->uv_to_texture, texture->has_uv_transform ? &texture->uv_to_texture : &ufbx_identity_matrix);
	}
}

// Whether a curve changes what is no place of a node and no weight of a channel.
static int is_other(const ufbx_anim_prop *prop)
{
	ufbx_element_type type = prop->element->type;
	int known = type == UFBX_ELEMENT_BLEND_CHANNEL || (type == UFBX_ELEMENT_NODE && !strncmp(prop->prop_name.data, "Lcl ", 4));
	for (size_t c = 0; c < 3 && !known; c++) {
		ufbx_anim_curve *curve = prop->anim_value->curves[c];
		if (curve && curve->min_value < curve->max_value) return 1;
	}
	return 0;
}

// Times of all keys, and of those that the next one follows at once rather than by a line or a curve; whether any moves
// each node, then each channel.
static void read_stacks(void)
{
	stack_row *rows = table(&row.stacks, scene->anim_stacks.count, sizeof(stack_row));
	for (size_t i = 0; i < scene->anim_stacks.count; i++) {
		ufbx_anim_stack *stack = scene->anim_stacks.data[i];
		rows[i].name = text(stack->name);
		rows[i].begin = stack->time_begin;
		rows[i].end = stack->time_end;
		uint8_t *moved = table(&rows[i].moved, scene->nodes.count + scene->blend_channels.count, 1);
		double *times = NULL, *held = NULL;
		for (int fill = 0; fill < 2; fill++) {
			size_t count = 0, steps = 0;
			for (size_t l = 0; l < stack->layers.count; l++) {
				ufbx_anim_prop_list props = stack->layers.data[l]->anim_props;
				for (size_t p = 0; p < props.count; p++) {
					if (fill && is_other(&props.data[p]) && !rows[i].others++) {
						rows[i].other_owner = text(props.data[p].element->name);
						rows[i].other_property = text(props.data[p].prop_name);
					}
					ufbx_element_type type = props.data[p].element->type;
					if (type != UFBX_ELEMENT_NODE && type != UFBX_ELEMENT_BLEND_CHANNEL) continue;
					moved[(type == UFBX_ELEMENT_NODE ? 0 : scene->nodes.count) + props.data[p].element->typed_id] = 1;
					for (size_t c = 0; c < 3; c++) {
						ufbx_anim_curve *curve = props.data[p].anim_value->curves[c];
						if (!curve) continue;
						for (size_t k = 0; k < curve->keyframes.count; k++) {
							ufbx_keyframe *key = &curve->keyframes.data[k];
							if (fill) times[count] = key->time;
							count++;
							int stepped = key->interpolation == UFBX_INTERPOLATION_CONSTANT_PREV
								|| key->interpolation == UFBX_INTERPOLATION_CONSTANT_NEXT;
							if (!stepped || k + 1 == curve->keyframes.count || key->value == key[1].value) continue;
							if (fill) {
								held[2 * steps] = key->time;
								held[2 * steps + 1] = key[1].time;
							}
							steps++;
						}
					}
				}
			}
			if (!fill) {
				times = table(&rows[i].times, count, sizeof(double));
				held = table(&rows[i].held, steps, 2 * sizeof(double));
			}
		}
	}
}

static void read_scene(void)
{
	ufbx_scene_settings *settings = &scene->settings;
	row.unit_meters = settings->unit_meters;
	row.frames_per_second = settings->frames_per_second;
	row.axes[0] = settings->axes.right;
	row.axes[1] = settings->axes.up;
	row.axes[2] = settings->axes.front;
	row.version = scene->metadata.version;
	row.lights = (uint32_t)scene->lights.count;
	row.cameras = (uint32_t)scene->cameras.count;
	row.constraints = (uint32_t)scene->constraints.count;
	row.caches = (uint32_t)scene->cache_deformers.count;
	read_nodes();
	read_meshes();
	read_deformers();
	read_materials();
	read_stacks();
	warning_row *warnings = table(&row.warnings, scene->metadata.warnings.count, sizeof(warning_row));
	for (size_t i = 0; i < scene->metadata.warnings.count; i++) {
		ufbx_warning *warning = &scene->metadata.warnings.data[i];
		warnings[i] = (warning_row){ text(warning->description), (uint32_t)warning->count, warning->type };
	}
}

// Room for `size` bytes, 0 where there is none.
EXPORT("allocate") uint32_t allocate(uint32_t size) { return (uint32_t)(size_t)malloc(size ? size : 1); }

// Reads the file at `data`: the address of the scene, or 0, and `failed` says why.
EXPORT("load") uint32_t load(uint32_t data, uint32_t size)
{
	ufbx_load_opts options = { 0 };
	static ufbx_error error;
	options.file_format = UFBX_FILE_FORMAT_FBX;
	options.node_depth_limit = MOST_DEPTH;
	options.path_separator = '/';
	options.use_blender_pbr_material = true;
	options.skip_mesh_parts = true;
	scene = ufbx_load_memory((const void *)(size_t)data, size, &options, &error);
	if (!scene) {
		failure = text(error.description);
		return 0;
	}
	free((void *)(size_t)data);
	read_scene();
	return (uint32_t)(size_t)&row;
}

EXPORT("failed") uint32_t failed(void) { return (uint32_t)(size_t)&failure; }

static ufbx_vec3 times(ufbx_vec3 a, ufbx_vec3 b) { return (ufbx_vec3){ { { a.x * b.x, a.y * b.y, a.z * b.z } } }; }

// World matrices of all nodes at a time, as ufbx computes them at rest: parents come first among nodes.
static void place(const ufbx_anim *anim, const uint8_t *moved, double time, ufbx_vec3 *scales, ufbx_matrix *unscaled,
	ufbx_matrix *worlds)
{
	const ufbx_vec3 one = { { { 1, 1, 1 } } };
	for (size_t i = 0; i < scene->nodes.count; i++) {
		ufbx_node *node = scene->nodes.data[i], *parent = node->parent;
		ufbx_transform local = moved[i] ? ufbx_evaluate_transform(anim, node, time) : node->local_transform;
		ufbx_matrix above = ufbx_identity_matrix;
		scales[i] = local.scale;
		if (parent && node->inherit_mode == UFBX_INHERIT_MODE_NORMAL) {
			above = worlds[parent->typed_id];
		} else if (parent) {
			ufbx_vec3 inherited = node->inherit_scale_node ? scales[node->inherit_scale_node->typed_id] : one;
			local.scale = scales[i] = times(local.scale, inherited);
			local.translation = times(local.translation, scales[parent->typed_id]);
			above = unscaled[parent->typed_id];
		}
		ufbx_matrix here = ufbx_transform_to_matrix(&local);
		worlds[i] = ufbx_matrix_mul(&above, &here);
		local.scale = one;
		here = ufbx_transform_to_matrix(&local);
		unscaled[i] = ufbx_matrix_mul(&above, &here);
	}
}

// Samples of an animation: at each of `count` times the world matrices of all nodes (12 numbers each), then the weights
// of all channels. The address, or 0 where there is no memory; the next call overwrites them.
EXPORT("sample") uint32_t sample(uint32_t stack, uint32_t at, uint32_t count)
{
	static double *samples;
	const ufbx_anim *anim = scene->anim_stacks.data[stack]->anim;
	const double *when = (const double *)(size_t)at;
	size_t nodes = scene->nodes.count, channels = scene->blend_channels.count;
	uint64_t size = (uint64_t)count * (12 * nodes + channels) * sizeof(double);
	free(samples);
	samples = size < INT32_MAX ? malloc((size_t)size + 1) : NULL;
	const uint8_t *moved = (const uint8_t *)(size_t)((stack_row *)(size_t)row.stacks.at)[stack].moved.at;
	ufbx_vec3 *scales = calloc(nodes + 1, sizeof(ufbx_vec3));
	ufbx_matrix *unscaled = calloc(nodes + 1, sizeof(ufbx_matrix)), *worlds = calloc(nodes + 1, sizeof(ufbx_matrix));
	if (!samples || !scales || !unscaled || !worlds) return 0;
	double *to = samples;
	for (uint32_t i = 0; i < count; i++) {
		place(anim, moved, when[i], scales, unscaled, worlds);
		for (size_t n = 0; n < nodes; n++, to += 12) matrix(to, &worlds[n]);
		for (size_t c = 0; c < channels; c++) {
			ufbx_blend_channel *channel = scene->blend_channels.data[c];
			*to++ = moved[nodes + c] ? ufbx_evaluate_blend_weight(anim, channel, when[i]) : channel->weight;
		}
	}
	free(scales);
	free(unscaled);
	free(worlds);
	return (uint32_t)(size_t)samples;
}
