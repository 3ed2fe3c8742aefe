# model.bin of ddprt for Godot 4: loads it, and turns measured light into the shader's rows. Checked by a parser alone.
class_name DdprtLightmap
extends RefCounted

var width: int
var height: int
var layers: int
var maps: int
var groups: int
var points: int
var samples: int
var inputs: int
var radiosity: bool
var gamma: float
var depth: float
var position: PackedFloat32Array
var normal: PackedFloat32Array
var albedo: PackedFloat32Array
var offset: PackedFloat32Array
var matrix: PackedFloat32Array
var intercept: PackedFloat32Array
var home: PackedInt32Array
var textures: Texture2DArray
var rows: ImageTexture
var constant: ImageTexture
var exitant: ImageTexture


# null, with an error in the log, where the file is not a model of this version.
static func load_model(path: String) -> DdprtLightmap:
	var bytes := FileAccess.get_file_as_bytes(path)
	if bytes.size() < 52 or bytes.slice(0, 8).get_string_from_ascii() != "ddprt001":
		push_error("%s: not a model of this version of ddprt; export it again" % path)
		return null
	var m := DdprtLightmap.new()
	m.width = bytes.decode_u32(8)
	m.height = bytes.decode_u32(12)
	m.layers = bytes.decode_u32(16)
	m.maps = bytes.decode_u32(20)
	m.groups = bytes.decode_u32(24)
	m.points = bytes.decode_u32(28)
	m.samples = bytes.decode_u32(32)
	var flags := bytes.decode_u32(36)
	m.radiosity = (flags & 4) != 0
	m.gamma = bytes.decode_float(40)
	m.depth = bytes.decode_float(44)
	m.inputs = m.points if m.groups == 3 else 3 * m.points
	var area := m.width * m.height
	var count := m.groups * (m.maps + 1)
	var sizes := [12 * m.samples, 12 * m.samples, 12 * m.samples, 4 * m.groups * m.inputs, 4 * count * m.inputs, 4 * count, 4 * m.samples, 8 * area * m.layers]
	sizes.append(12 * area if flags & 1 else 0)
	sizes.append(area if flags & 2 else 0)
	var ends := [48]
	for size in sizes:
		ends.append(ends[-1] + size)
	if bytes.size() != ends[-1] + 4:
		push_error("%s: its size is not what it says; export it again" % path)
		return null
	var parts := []
	for index in sizes.size():
		parts.append(bytes.slice(ends[index], ends[index + 1]))
	m.position = parts[0].to_float32_array()
	m.normal = parts[1].to_float32_array()
	m.albedo = parts[2].to_float32_array()
	m.offset = parts[3].to_float32_array()
	m.matrix = parts[4].to_float32_array()
	m.intercept = parts[5].to_float32_array()
	m.home = parts[6].to_int32_array()
	var images: Array[Image] = []
	for layer in m.layers:
		images.append(Image.create_from_data(m.width, m.height, false, Image.FORMAT_RGBAH, parts[7].slice(8 * area * layer, 8 * area * (layer + 1))))
	m.textures = Texture2DArray.new()
	m.textures.create_from_images(images)
	m.rows = ImageTexture.create_from_image(Image.create(3 * m.layers + 2, 1, false, Image.FORMAT_RGBAF))
	if flags & 1:
		m.constant = ImageTexture.create_from_image(Image.create_from_data(m.width, m.height, false, Image.FORMAT_RGBF, parts[8]))
	if flags & 2:
		var ones: PackedByteArray = parts[9]
		for index in ones.size():
			ones[index] = 255 * ones[index]
		m.exitant = ImageTexture.create_from_image(Image.create_from_data(m.width, m.height, false, Image.FORMAT_R8, ones))
	return m


# Once for each material that has ddprt.gdshader.
func prepare(material: ShaderMaterial) -> void:
	material.set_shader_parameter("layers", textures)
	material.set_shader_parameter("rows", rows)
	if constant:
		material.set_shader_parameter("constant_light", constant)
	if exitant:
		material.set_shader_parameter("exitant", exitant)


# shaded: irradiance at `position` with `normal`, (samples, 3), W/m2, by your own lamps and shadows.
func average(shaded: PackedFloat32Array) -> PackedFloat32Array:
	var values := PackedFloat32Array()
	values.resize(3 * points)
	var count := PackedInt32Array()
	count.resize(points)
	for k in samples:
		count[home[k]] += 1
	for k in samples:
		for c in 3:
			var leaving := shaded[3 * k + c] * (albedo[3 * k + c] if radiosity else 1.0)
			values[3 * home[k] + c] += leaving / count[home[k]]
	return values


# Each frame, or when the light changes; all prepared materials follow. shaded: as for `average`.
func relight(shaded: PackedFloat32Array) -> void:
	var data := rows_of(average(shaded)).to_byte_array()
	rows.update(Image.create_from_data(3 * layers + 2, 1, false, Image.FORMAT_RGBAF, data))


# Rows of four floats that the shader reads.
func rows_of(values: PackedFloat32Array) -> PackedFloat32Array:
	var s := [0.0, 0.0, 0.0]
	for i in values.size():
		s[i % 3 if groups == 3 else 0] += values[i] * values[i]
	for c in 3:
		s[c] = sqrt(s[c] if groups == 3 or c == 0 else 0.0)
	if groups == 1:
		s[1] = s[0]
		s[2] = s[0]
	var z := PackedFloat64Array()
	z.resize(groups * inputs)
	for i in values.size():
		var at := (i % 3) * inputs + i / 3 if groups == 3 else i
		var share: float = values[i] / s[i % 3] if s[i % 3] > 0.0 else 0.0
		z[at] = sign(share) * pow(abs(share), 1.0 / gamma) - offset[at]
	var found := PackedFloat32Array()
	found.resize(4 * (3 * layers + 2))
	for c in 3:
		var group := c if groups == 3 else 0
		for k in maps + 1:
			var at := group * (maps + 1) + k
			var u := intercept[at]
			for i in inputs:
				u += matrix[at * inputs + i] * z[group * inputs + i]
			if k == maps:
				found[12 * layers + c] = u
			elif groups == 3:
				found[4 * (3 * (k / 4) + c) + k % 4] = u
			else:
				found[4 * (3 * k + c) + c] = u
		found[12 * layers + 4 + c] = s[c]
	return found
